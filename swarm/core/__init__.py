"""What several processes need and that does no IO: lockstep, graphs, packed states."""
