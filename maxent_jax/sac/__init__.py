"""Soft actor-critic as pure functions: networks, replay, losses, agent (init / update / act)."""
