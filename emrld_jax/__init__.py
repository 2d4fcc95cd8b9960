"""Meta-reinforcement learning from demonstrations, in JAX."""
