"""Does the learner learn? SAC on Ant's forward velocity, with the settings of a preset.

This check separates a broken learner from a hard reward. Environment, networks, replay and update
are those of training, but the reward is the velocity along x in metres per second.
"""

import argparse
import functools
import sys
import time

import jax
import jax.numpy as jnp

from benchmarks import common
from maxent_jax import components
from maxent_jax.config import Config, preset
from maxent_jax.envs import base
from maxent_jax.sac import agent, losses, replay


@functools.partial(jax.jit, static_argnums=0)
def init(config: Config, key: jax.Array):
    p = components.make(config)
    key_agent, key_episodes = jax.random.split(key)
    episodes = base.init(p.env, config.budget.num_envs, config.environment.num_starts, key_episodes)
    scalar, state = jnp.zeros(()), jnp.zeros(p.sac.observation_size)
    action = jnp.zeros(p.sac.action_size)
    ring = replay.init(
        losses.Batch(state, action, scalar, state, scalar), config.learner.replay_size
    )
    return agent.init(p.sac, key_agent), episodes, ring


def step(config: Config, carry, key: jax.Array):
    """Takes one vector step with its gradient steps; also returns the mean forward velocity."""
    p = components.make(config)
    learner, episodes, ring = carry
    key_act, key_env, key_sample, key_update = jax.random.split(key, 4)
    action = agent.act(p.sac, learner.parameters.policy, episodes.env.obs, key_act)
    episodes, t = base.step(p.env, episodes, action, config.environment.episode_length, key_env)
    velocity = (t.next_observation[:, 0] - t.observation[:, 0]) / p.env.dt
    alive = 1.0 - t.terminated.astype(jnp.float32)
    ring = replay.add(
        ring, losses.Batch(t.observation, t.action, velocity, t.next_observation, alive), t.valid
    )
    shape = (config.updates_per_vector_step, config.learner.batch_size)
    batches = replay.sample(ring, shape, key_sample)
    learner, _ = jax.lax.scan(
        lambda a, x: agent.update(p.sac, a, *x),
        learner,
        (batches, jax.random.split(key_update, shape[0])),
    )
    return (learner, episodes, ring), jnp.mean(velocity)


@functools.partial(jax.jit, static_argnums=(0, 3), donate_argnums=1)
def steps(config: Config, carry, key: jax.Array, num: int):
    return jax.lax.scan(functools.partial(step, config), carry, jax.random.split(key, num))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--seconds", type=float, default=180.0, help="time of training, without compilation"
    )
    parser.add_argument(
        "--toy", action="store_true", help="check that it runs: one segment of smoke"
    )
    args = parser.parse_args()
    name, budget = ("smoke", 0.0) if args.toy else (args.preset, args.seconds)
    config = preset(name, random_baseline=False)
    common.print_versions()
    key, key_init = jax.random.split(jax.random.key(args.seed))
    carry = init(config, key_init)
    vector_steps = config.vector_steps
    compiled = steps.lower(config, carry, key, vector_steps).compile()
    started, done = time.perf_counter(), 0
    while done == 0 or time.perf_counter() - started < budget:
        key, key_steps = jax.random.split(key)
        carry, velocities = compiled(carry, key_steps)
        velocity = float(jnp.mean(velocities))
        done += vector_steps
        seconds = time.perf_counter() - started
        print(f"{seconds:5.0f} s  {velocity:6.2f} m/s", file=sys.stderr)
    row = {
        "benchmark": "forward_velocity",
        "seed": args.seed,
        "env_steps": done * config.budget.num_envs,
        "gradient_steps": done * config.updates_per_vector_step,
        "mean_velocity_last_segment": round(velocity, 3),
        "wall_seconds": round(time.perf_counter() - started, 1),
    }
    common.emit(row)


if __name__ == "__main__":
    main()
