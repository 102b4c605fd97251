"""The settings of each preset, and how they change with the environment and the method."""

from typing import Any

from maxent_jax.checks import check_choice
from maxent_jax.config import registry
from maxent_jax.config.registry import CLASSIC_ENVS, METRA, MUJOCO_ENVS
from maxent_jax.errors import ConfigError

_FAST_LEARNER: dict[str, Any] = dict(
    critic_layer_norm=True,
    learning_rate=1e-3,
    return_steps=3,
    initial_temperature=0.1,
    restart_temperature=True,
)

PRESETS: dict[str, dict[str, Any]] = {
    "smoke": dict(
        num_iterations=2,
        steps_per_iteration=400,
        updates_per_step=0.25,
        num_envs=4,
        num_segments=2,
        episode_length=100,
        num_starts=64,
        reference_size=256,
        mixture_episodes=8,
        hidden_size=32,
        batch_size=32,
        replay_size=2_000,
    ),
    "quick": dict(
        num_envs=64,
        steps_per_iteration=120_000,
        updates_per_step=0.25,
        hidden_size=128,
        **_FAST_LEARNER,
        policy_lag=1,
        replay_size=240_000,
    ),
    "gpu": dict(
        num_iterations=20,
        num_envs=2048,
        steps_per_iteration=2_048_000,
        num_segments=20,
        updates_per_step=1 / 64,
        batch_size=4096,
        **_FAST_LEARNER,
        reference_size=131_072,
        mixture_episodes=256,
        random_baseline=False,
    ),
    "paper": dict(
        num_iterations=20,
        steps_per_iteration=150_000,
        updates_per_step=1.0,
        num_envs=16,
        num_segments=25,
        reward="paper",
        episodic_weight=0.1,
        leave_own_out=False,
        reference_size=16_384,
        mixture_episodes=64,
    ),
}

_LOCOMOTION = dict(
    shaping=100.0,
    shaping_space="position",
    lagrangian_entropy=True,
    reward_distance=20.0,
    reward_scale=8.0,
)
_CLASSIC = dict(episode_length=200)
_ROBOTS: dict[str, dict[str, Any]] = {
    "ant": dict(
        torque_limit=0.4,
        end_flipped=True,
        policy_inputs="heading",
        yaw_copies=1,
        **_LOCOMOTION,
    ),
    "walker2d": dict(normalize_inputs=True, actor_average=1e-3, **_LOCOMOTION),
    "humanoid": dict(
        policy_inputs="heading",
        yaw_copies=1,
        alive_bonus=0.7,
        target_entropy_scale=0.0,
        actor_average=1e-3,
        **_LOCOMOTION,
    ),
}
_LONG: dict[str, Any] = dict(
    num_envs=128,
    steps_per_iteration=960_000,
    replay_size=960_000,
    snapshots=3,
    mixture_episodes=64,
)
# An iteration has 15,000 gradient steps on Ant, 120,000 on Walker2d, 240,000 on Humanoid: enough to
# learn to walk.
_BUDGETS = {
    "ant": dict(num_iterations=12, updates_per_step=0.125, random_baseline=False),
    "walker2d": dict(num_iterations=3, updates_per_step=0.125, **_LONG),
    # A random policy's steps cost as much as the agent's: here a quarter of the run's time.
    "humanoid": dict(num_iterations=4, updates_per_step=0.25, random_baseline=False, **_LONG),
}

# What a protocol changes in every preset. METRA's episodes are shorter, so there are fewer states.
PROTOCOLS: dict[str, dict[str, Any]] = {
    "own": {},
    "metra": dict(
        episode_length=200,
        end_unhealthy=False,
        end_flipped=False,
        mixture_episodes=48,
        reference_size=8192,
        deterministic=True,
    ),
}


def of_protocol(name: str, env: str) -> dict[str, Any]:
    """Returns the settings of a protocol.

    Raises:
      ConfigError: the protocol is unknown, or not for this environment.
    """
    check_choice("protocol", name, PROTOCOLS)
    settings = PROTOCOLS[name]
    if settings and not registry.environment(env).is_robot:
        raise ConfigError(
            f"protocol is {name}, but {env} has none: choose {', '.join(MUJOCO_ENVS)}."
        )
    return settings


# What a preset changes in some environments.
IN_ENV: dict[tuple[str, str], dict[str, Any]] = {
    **{("quick", env): changes | _BUDGETS.get(env, {}) for env, changes in _ROBOTS.items()},
    **{("gpu", env): dict(physics="fast", **changes) for env, changes in _ROBOTS.items()},
    **{
        ("gpu", env): dict(reference_size=32_768, reward_distance=0.1, **_CLASSIC)
        for env in CLASSIC_ENVS
    },
    **{("paper", env): dict(reference_size=8_192, **_CLASSIC) for env in CLASSIC_ENVS},
    **{
        ("quick", env): dict(
            steps_per_iteration=19_200,
            reference_size=4_096,
            reward_distance=0.1,
            **_CLASSIC,
        )
        for env in CLASSIC_ENVS
    },
}

# What a method changes in some environments, by preset. If V on Walker2d starts from the best
# policy, it only walks in that policy's direction (docs/results/learning.md). METRA has its
# authors' budget and, except in `quick`, their networks, which are too large for a CPU. In `paper`
# it has the budget and the networks of the other baselines.
OF_METHOD_IN_ENV: dict[tuple[str, str, str], dict[str, Any]] = {
    **{(preset, "walker2d", "v"): dict(start="scratch") for preset in ("quick", "gpu")},
    **{
        (preset, env, METRA): dict(
            updates_per_step=1 / 32,
            hidden_size=hidden_size,
            learning_rate=1e-4,
            batch_size=256,
            replay_size=1_000_000,
        )
        for preset, hidden_size in (("quick", 256), ("gpu", 1024))
        for env in MUJOCO_ENVS
    },
}
