"""Commands and programs of ours on robots, over the user's own ssh: one robot, or all of them at the same time."""
