"""Studies of the paper as functions that return numbers."""
