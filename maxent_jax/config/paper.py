"""How a run departs from the paper. Loads no array library."""

from collections.abc import Mapping
from typing import Any

from maxent_jax.config import registry

# By setting: the paper's value, and how a run describes another value.
_PAPER: dict[str, tuple[Any, str]] = {
    "physics": ("reference", "the physics is simplified"),
    "torque_limit": (1.0, "torques are limited to a fraction of the control range"),
    "end_flipped": (False, "an episode also ends when the robot is upside down"),
    "end_unhealthy": (True, "an episode continues after health fails"),
    "cell_restarts": (0.0, "episodes also begin at states of visited cells"),
    "skill_size": (0, "each episode has a skill, which the networks see"),
    "policy_inputs": ("state", "networks see the state in the robot's heading frame"),
    "yaw_copies": (0, "SAC also learns from episodes turned by a random yaw"),
    "reward": ("paper", "the reward's form is not p log R"),
    "reward_scale": (1.0, "the reward is scaled"),
    "alive_bonus": (0.0, "each step survived adds a constant reward"),
    "stale_rewards": (False, "rewards are not updated to the current reference"),
    "shaping": (0.0, "the reward is shaped by a potential"),
    "shaping_survives_death": (False, "the potential is kept at death: not policy-invariant"),
    "pooled": (False, "the reference is drawn from the pooled states of the mixture"),
    "snapshots": (1, "an iteration archives more than one policy"),
    "bonus": ("none", "the reward is not the distance to the reference"),
    "mixing": ("episode", "the mixture draws a policy at each step"),
    "deterministic": (False, "policies are evaluated with their mean actions"),
    "eta": (0.1, "η is not 0.1"),
    "num_neighbors": (3, "k is not 3"),
    "leave_own_out": (False, "policies are scored without their own states"),
    "hidden_layers": (2, "networks do not have 2 hidden layers"),
    "hidden_size": (256, "hidden layers are not 256 wide"),
    "critic_layer_norm": (False, "critics have layer norm"),
    "learning_rate": (3e-4, "Adam's learning rate is not 3e-4"),
    "batch_size": (128, "the batch size is not 128"),
    "replay_size": (1_000_000, "the replay buffer does not hold 1e6 transitions"),
    "replay_dtype": ("float32", "states in the replay buffer are rounded to 16 bits"),
    "discount": (0.99, "γ is not 0.99"),
    "return_steps": (1, "critics learn from n-step returns"),
    "soft_update_rate": (0.005, "the soft update rate is not 0.005"),
    "initial_temperature": (0.2, "the initial temperature is not 0.2"),
    "target_entropy_scale": (1.0, "the target entropy is not minus the number of action dims"),
    "lagrangian_entropy": (False, "the soft return counts entropy relative to its target"),
    "normalize_inputs": (False, "network inputs have mean 0 and standard deviation 1"),
    "policy_lag": (0, "gradient steps do not see the newest steps of the environments"),
    "actor_average": (0.0, "a moving average of the actor is archived"),
    "task": ("none", "a task is rewarded"),
    "start_from": ("scratch", "training starts from what another run learned"),
    "restart_share": (0.0, "episodes also begin at states within earlier episodes"),
    "critic_steps": (0, "at first only the critics learn"),
    "restart_temperature": (False, "the temperature is reset at each iteration"),
}


def deviations(
    env: str, settings: Mapping[str, Any], defaults: Mapping[str, Any]
) -> dict[str, str]:
    """Returns, by setting, a phrase on each departure from the paper."""
    steps = registry.environment(env).time_limit
    paper = _PAPER | {"episode_length": (steps, f"the time limit is not {steps} steps")}
    named = {name: why for name, (value, why) in paper.items() if settings[name] != value}
    if settings["shaping"] > 0 and settings["shaping_space"] == "position":
        named["shaping_space"] = "the potential is measured in position only"
    if settings["reward"] != "paper":
        named["reward_distance"] = "the reward has a scale c"
    if settings["episodic_weight"] == 0:
        named["episodic_weight"] = "no episodic term"
    for name in ("weights", "reference", "start", "refresh_period"):
        if settings[name] != defaults[name]:
            named[name] = "set independently of the method"
    return named
