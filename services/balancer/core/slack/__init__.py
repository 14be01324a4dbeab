"""The work in the slack of the ticks: transfers, their durations, and their order."""
