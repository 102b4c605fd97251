"""What a run does otherwise than the paper. Loads no array library."""

from collections.abc import Mapping
from typing import Any

from maxent_jax.config import registry

# What the paper does, and how a run that does otherwise says so.
_PAPER: dict[str, tuple[Any, str]] = {
    "physics": ("reference", "the physics is simplified"),
    "torque_limit": (1.0, "torques are limited to a share of the control range"),
    "end_flipped": (False, "an episode also ends upside down"),
    "end_unhealthy": (True, "an episode goes on where health fails"),
    "policy_inputs": ("state", "networks see the state in the heading's frame"),
    "yaw_copies": (0, "episodes turned by a random yaw are learned from too"),
    "reward": ("paper", "the reward's form is not p log R"),
    "reward_scale": (1.0, "the reward is scaled"),
    "alive_bonus": (0.0, "a step alive is paid for"),
    "stale_rewards": (False, "rewards are not those of the current reference"),
    "shaping": (0.0, "the reward is shaped by a potential"),
    "shaping_survives_death": (False, "the potential survives death: not policy-invariant"),
    "pooled": (False, "the reference is drawn from the pooled states of the mixture"),
    "snapshots": (1, "an iteration archives more than one policy"),
    "bonus": ("none", "SAC is not paid by the distance to the reference"),
    "mixing": ("episode", "a policy of the mixture is drawn for each step"),
    "deterministic": (False, "policies are evaluated by their mean actions"),
    "eta": (0.1, "η is not 0.1"),
    "num_neighbors": (3, "k is not 3"),
    "leave_own_out": (False, "policies are scored without their own states"),
    "hidden_layers": (2, "networks do not have 2 hidden layers"),
    "hidden_size": (256, "hidden layers are not 256 wide"),
    "critic_layer_norm": (False, "critics have layer norm"),
    "learning_rate": (3e-4, "Adam's rate is not 3e-4"),
    "batch_size": (128, "the batch is not 128"),
    "replay_size": (1_000_000, "the replay does not hold 1e6 transitions"),
    "replay_dtype": ("float32", "states in the replay are rounded to 16 bits"),
    "discount": (0.99, "γ is not 0.99"),
    "return_steps": (1, "critics learn from returns of several steps"),
    "soft_update_rate": (0.005, "the soft update is not 0.005"),
    "initial_temperature": (0.2, "the temperature starts elsewhere than at 0.2"),
    "target_entropy_scale": (1.0, "the target entropy is not minus the number of actions"),
    "lagrangian_entropy": (False, "the soft return counts entropy from its target"),
    "normalize_inputs": (False, "networks see inputs of mean 0 and deviation 1"),
    "actor_average": (0.0, "an average of the actor over its updates is archived"),
    "restart_temperature": (False, "the temperature restarts in each iteration"),
}


def deviations(
    env: str, settings: Mapping[str, Any], defaults: Mapping[str, Any]
) -> dict[str, str]:
    """By setting: in words, what these settings do otherwise than the paper."""
    steps = registry.environment(env).time_limit
    paper = _PAPER | {"episode_length": (steps, f"the time limit is not {steps} steps")}
    named = {name: why for name, (value, why) in paper.items() if settings[name] != value}
    if settings["shaping"] > 0 and settings["shaping_space"] == "position":
        named["shaping_space"] = "the potential is measured in position alone"
    if settings["reward"] != "paper":
        named["reward_distance"] = "the scale c of the reward's form"
    if settings["episodic_weight"] == 0:
        named["episodic_weight"] = "no episodic term"
    for name in ("weights", "reference", "start", "refresh_period"):
        if settings[name] != defaults[name]:
            named[name] = "set apart from its method"
    return named
