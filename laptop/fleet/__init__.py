"""All robots at once from a laptop, over the user's own ssh: one command and one outcome for each."""
