"""The code without IO that several processes need: lockstep, graphs, packed states."""
