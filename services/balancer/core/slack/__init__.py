"""What is done in the slack of the ticks: transfers, how long they take, and whose turn it is."""
