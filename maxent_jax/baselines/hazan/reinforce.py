"""Policies of three actions, their trajectories, and REINFORCE.

Source: Williams 1992; cart_entropy_policy.py of github.com/abbyvansoest/maxent_base.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import State

from maxent_jax import envs
from maxent_jax.baselines.hazan.settings import Settings
from maxent_jax.density import histogram
from maxent_jax.envs import pendulum

NUM_ACTIONS = 3  # backwards, none, forwards
EPSILON = float(np.finfo(np.float32).eps)  # official: added to the deviation of the returns

Policy = tuple[tuple[jax.Array, jax.Array], ...]  # weight [I, O] and bias [O] of each layer
Probabilities = Callable[[jax.Array], jax.Array]  # observation [D] -> [3]


class Path(NamedTuple):
    """T steps of one trajectory, which continues from a plain reset after each end."""

    observation: jax.Array  # [T, D] for which the action was chosen
    action: jax.Array  # [T] int32, 0 to 2
    reached: jax.Array  # [T, D] observation after the step
    state: jax.Array  # [T, 2] physics after the step
    ended: jax.Array  # [T] bool: at the goal


def init_policy(settings: Settings, key: jax.Array) -> Policy:
    """Draws Xavier-uniform weights, and biases uniform within ±1/sqrt(inputs) as in PyTorch."""
    hidden = settings.hidden_size
    sizes = (envs.make(settings.env).observation_size, hidden, hidden, NUM_ACTIONS)
    shapes = [(inputs + 1, outputs) for inputs, outputs in itertools.pairwise(sizes)]
    ends = np.cumsum([np.prod(shape) for shape in shapes])
    uniform = jax.random.uniform(key, (ends[-1],), minval=-1.0)  # one draw compiles faster

    def layer(shape, numbers):
        inputs, outputs = shape[0] - 1, shape[1]
        numbers = numbers.reshape(shape)
        return (6 / (inputs + outputs)) ** 0.5 * numbers[:-1], inputs**-0.5 * numbers[-1]

    return tuple(map(layer, shapes, jnp.split(uniform, ends[:-1])))


def logits(policy: Policy, observation: jax.Array) -> jax.Array:
    """Returns the logits of the actions, [D] -> [3], with ReLU between the layers."""
    *hidden, (weight, bias) = policy
    for inner in hidden:
        observation = jax.nn.relu(observation @ inner[0] + inner[1])
    return observation @ weight + bias


def probabilities_of(policy: Policy) -> Probabilities:
    """Returns the function that gives a policy's action probabilities."""
    return lambda observation: jax.nn.softmax(logits(policy, observation))


def random_probabilities(_observation: jax.Array) -> jax.Array:
    """Gives every action the same probability, [D] -> [3]."""
    return jnp.full(NUM_ACTIONS, 1 / NUM_ACTIONS)


def plain_reset(settings: Settings, uniform: jax.Array) -> jax.Array:
    """Makes a physics state [2] from uniform numbers [2]."""
    low, high = jnp.array(settings.reset_low), jnp.array(settings.reset_high)
    return low + (high - low) * uniform


def rollout(
    settings: Settings, probabilities: Probabilities, start: jax.Array, uniform: jax.Array
) -> Path:
    """Plays a trajectory from a physics state.

    As in the official code, after an end the policy still sees the state at the goal.

    Args:
      probabilities: of the actions, given an observation.
      start: [2] physics state.
      uniform: [T, 3] uniform numbers that draw the actions and resets.
    Returns:
      The path of T steps.
    """
    env = envs.make(settings.env)
    observed = pendulum.observe(start) if settings.env == "pendulum" else start
    zero = jnp.zeros(())

    def step(carry, uniform):
        state, observation = carry
        action = _draw_action(probabilities(observation), uniform[0])
        control = settings.action_scale * (action[None] - 1.0)
        after = env.step(State(state, observation, zero, zero), control)
        ended = after.done > 0
        goes_on = jnp.where(ended, plain_reset(settings, uniform[1:]), after.pipeline_state)
        path = Path(observation, action, after.obs, after.pipeline_state, ended)
        return (goes_on, after.obs), path

    return jax.lax.scan(step, (start, observed), uniform)[1]


def normalised_returns(rewards: jax.Array, discount: float) -> jax.Array:
    """Returns the discounted sum of `rewards` [T] from each step on, [T], standardised."""
    add = lambda later, reward: (reward + discount * later,) * 2
    returns = jax.lax.scan(add, jnp.zeros(()), rewards, reverse=True)[1]
    return (returns - jnp.mean(returns)) / (jnp.std(returns, ddof=1) + EPSILON)


def loss(policy: Policy, path: Path, returns: jax.Array) -> jax.Array:
    """Returns minus the sum over an episode of log-probability times `returns` [T]."""
    log_probabilities = jax.nn.log_softmax(jax.vmap(logits, (None, 0))(policy, path.observation))
    chosen = jnp.take_along_axis(log_probabilities, path.action[:, None], axis=1)[:, 0]
    return -jnp.sum(chosen * returns)


def train(
    settings: Settings,
    reward: jax.Array,
    start: jax.Array,
    num_episodes: jax.Array | int,
    key: jax.Array,
) -> tuple[Policy, jax.Array]:
    """Trains a policy from scratch.

    Args:
      reward: [cells] of the state reached.
      start: [2] physics state in which the first and then every second episode begins; the others
        begin with a plain reset.
      num_episodes: [] episodes, with one Adam update after each.
    Returns:
      The policy, and how often training visited each cell, [bins, bins] int32.
    """
    grid = envs.entry(settings.env).grid
    optimizer = optax.adam(settings.learning_rate)
    key_policy, key_episodes = jax.random.split(key)
    policy = init_policy(settings, key_policy)

    def episode(i, learner):
        policy, moments, visits = learner
        key_episode = jax.random.fold_in(key_episodes, i)
        uniform = jax.random.uniform(key_episode, (settings.train_steps + 1, 3))
        begin = jnp.where(i % 2 == 0, start, plain_reset(settings, uniform[0, 1:]))
        path = rollout(settings, probabilities_of(policy), begin, uniform[1:])
        returns = normalised_returns(reward[histogram.cells(path.reached, grid)], settings.discount)
        change, moments = optimizer.update(jax.grad(loss)(policy, path, returns), moments)
        visits = visits + histogram.count(path.reached, grid)
        return optax.apply_updates(policy, change), moments, visits

    learner = (policy, optimizer.init(policy), jnp.zeros(grid.bins, jnp.int32))
    policy, _, visits = jax.lax.fori_loop(0, num_episodes, episode, learner)
    return policy, visits


def _draw_action(probabilities: jax.Array, uniform: jax.Array) -> jax.Array:
    thresholds = jnp.stack([probabilities[0], probabilities[0] + probabilities[1]])
    return jnp.sum(uniform >= thresholds, dtype=jnp.int32)
