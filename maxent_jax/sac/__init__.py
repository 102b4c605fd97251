"""Soft actor-critic as pure functions: networks, replay buffer, losses, agent."""
