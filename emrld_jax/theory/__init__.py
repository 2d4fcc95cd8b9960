"""The improvement that Theorem 3.2 promises: its terms, and exact problems to try it on."""
