"""Studies of many trainings: which there are, carrying them out, and drawing what they found."""
