"""Commands for all robots at once from a laptop, over the user's own ssh. Each robot gets the command and has an
outcome."""
