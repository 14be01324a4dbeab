"""What a robot's processes and simulations take: CPU time, memory, and what a recording adds."""
