"""Speaking to the buses of robots: which ones are meant, questions and their answers, and how a sample looks."""
