"""Episodes, and how much better than expected each of their actions was."""
