"""The physics step: the two backends against each other, and what makes it a pure function."""

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from maxent_jax.envs import ant, physics
from maxent_jax.envs.physics import PhysicsState

FRAME_SKIP = 5
NUM_EPISODES, LENGTH = 10, 40
NUM_TURNED = 64  # of the states, also stepped in a turned world


@pytest.fixture(scope="module")
def model():
    return physics.load_model("ant.xml", "reference")


@pytest.fixture(scope="module")
def step(model):
    return jax.jit(physics.make_step(model, "mujoco", FRAME_SKIP))


def start(model, keys):
    rest = PhysicsState(
        jnp.asarray(model.qpos0, jnp.float32), jnp.zeros(model.nv), jnp.zeros(model.nv)
    )
    return jax.vmap(ant.reset, in_axes=(0, None))(keys, rest)


@pytest.fixture(scope="module")
def visited(model, step):
    """States and controls [B, ...] of a random policy, warm starts included."""
    key_start, key_control = jax.random.split(jax.random.key(0))
    states = [start(model, jax.random.split(key_start, NUM_EPISODES))]
    controls = jax.random.uniform(key_control, (LENGTH, NUM_EPISODES, 8), minval=-1, maxval=1)
    for control in controls[:-1]:
        states.append(step(states[-1], control))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *states), controls.reshape(-1, 8)


def rows_of(tree, rows):
    return jax.tree.map(lambda x: x[rows], tree)


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def turned(state, angle):
    velocity = jnp.concatenate([state.qpos, state.qvel], axis=-1)
    acceleration = jnp.concatenate([state.qpos, state.warmstart], axis=-1)
    result = ant.rotate(velocity, angle)
    return PhysicsState(result[:, :15], result[:, 15:], ant.rotate(acceleration, angle)[:, 15:])


def relative_error(a, b):
    return np.linalg.norm(a - b, axis=1) / np.linalg.norm(a, axis=1)


@pytest.fixture(scope="module")
def by_mjx(model, visited):
    """What MJX makes of `visited`, and of its first states in a turned world: one compilation."""
    states, controls = visited
    angle = jnp.linspace(-3, 3, NUM_TURNED)
    first = turned(rows_of(states, slice(NUM_TURNED)), angle)
    both = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), states, first)
    after = jax.jit(physics.make_step(model, "mjx", FRAME_SKIP))(
        both, jnp.concatenate([controls, controls[:NUM_TURNED]])
    )
    count = len(controls)
    return rows_of(after, slice(count)), turned(rows_of(after, slice(count, None)), -angle)


def test_the_backends_agree(step, visited, by_mjx):
    by_c, (by_mjx, _) = step(*visited), by_mjx
    error = relative_error(by_c.qvel, by_mjx.qvel)
    # Measured: median 1.4e-7, 99th percentile 3e-6, largest 1e-4, float32 against float64 through
    # contacts. Bounds of 1e-3 and 2e-2 were asked for.
    assert np.median(error) < 1e-6
    assert np.quantile(error, 0.99) < 1e-4
    np.testing.assert_allclose(by_c.qpos, by_mjx.qpos, atol=1e-3)  # measured 2e-5


def test_mjx_is_symmetric_under_turns(by_mjx):
    straight, turned_back = by_mjx
    error = relative_error(rows_of(straight, slice(NUM_TURNED)).qvel, turned_back.qvel)
    # Measured 4e-7. With contact frames that forget the capsule it is 1e-2 and more for some.
    assert error.max() < 1e-4


CAPSULE = """<mujoco><worldbody><geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.1" axisangle="1 2 0 {degrees}"><freejoint/>
    <geom type="capsule" size="0.1 0.2"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("degrees", [0.0, 0.1, 10, 29, 31, 90])
def test_contact_frames_of_a_capsule_are_those_of_c(degrees):
    model = mujoco.MjModel.from_xml_string(CAPSULE.format(degrees=degrees))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    device_model = mjx.put_model(model)

    @jax.jit
    def contacts(blank):
        return mjx.collision(device_model, mjx.kinematics(device_model, blank))._impl.contact

    with jax.numpy_rank_promotion("allow"), physics._capsule_frames():
        found = contacts(mjx.make_data(device_model))
    assert data.ncon in (1, 2)
    lowest = np.argmin(found.dist), np.argmin(data.contact.dist)
    np.testing.assert_allclose(
        np.ravel(found.frame[lowest[0]]), data.contact.frame[lowest[1]], atol=1e-5
    )


LEADING = {"single": (), "one axis": (6,), "three axes": (2, 1, 3)}


@pytest.mark.parametrize("leading", LEADING.values(), ids=LEADING)
@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_any_leading_axes_give_the_rows_of_one(step, model, visited, leading, compiled):
    count = int(np.prod(leading))
    few = rows_of(visited, slice(-count, None))
    shaped = jax.tree.map(lambda x: x.reshape(*leading, x.shape[-1]), few)
    function = step if compiled else physics.make_step(model, "mujoco", FRAME_SKIP)
    after = function(*shaped)
    assert after.qpos.shape == (*leading, 15)
    flat = jax.tree.map(lambda x: x.reshape(count, x.shape[-1]), after)
    assert_same_bits(flat, step(*few))


def test_vmap_gives_the_bits_of_a_batch(step, visited):
    few = rows_of(visited, slice(-6, None))
    pairs = jax.tree.map(lambda x: x.reshape(3, 2, -1), few)
    after = jax.jit(jax.vmap(jax.vmap(step)))(*pairs)
    assert_same_bits(jax.tree.map(lambda x: x.reshape(6, -1), after), step(*few))


def test_vmap_shares_what_it_does_not_map(step, visited):
    states, controls = rows_of(visited, slice(-4, None))
    shared = jax.vmap(step, in_axes=(0, None))(states, controls[0])
    assert_same_bits(shared, step(states, jnp.broadcast_to(controls[0], controls.shape)))


def test_a_row_does_not_depend_on_its_batch(step, visited):
    after = step(*visited)
    few = rows_of(visited, jnp.array([399, 3, 200, 3]))
    assert_same_bits(step(*few), rows_of(after, jnp.array([399, 3, 200, 3])))
    assert_same_bits(step(*visited), after)


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e30])
def test_a_diverged_row_shows_and_harms_no_other(step, visited, poison, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT where it stands
    few = rows_of(visited, slice(-8, None))
    expected = step(*few)
    state, control = few
    poisoned = step(state._replace(qvel=state.qvel.at[3, 5].set(poison)), control)
    good = jnp.array([0, 1, 2, 4, 5, 6, 7])
    assert_same_bits(rows_of(poisoned, good), rows_of(expected, good))
    assert not np.isfinite(np.concatenate([x[3] for x in poisoned])).all()
    assert_same_bits(step(*few), expected)  # nor does it leave anything behind


def test_scan_is_the_same_steps(step, visited):
    states, controls = rows_of(visited, slice(-8, None))
    many = jnp.stack([controls, -controls, 0.5 * controls])
    scanned, _ = jax.jit(lambda s: jax.lax.scan(lambda s, u: (step(s, u), None), s, many))(states)
    stepped = states
    for control in many:
        stepped = step(stepped, control)
    assert_same_bits(scanned, stepped)


def test_the_warm_start_travels_between_steps(visited):
    # One solver iteration, so that the result leans on where the solver starts.
    model = physics.load_model("ant.xml", "reference")
    model.opt.iterations = 1
    at_once = physics.make_step(model, "mujoco", 2 * FRAME_SKIP)(*visited)
    step = physics.make_step(model, "mujoco", FRAME_SKIP)
    states, controls = visited
    middle = step(states, controls)
    dropped = middle._replace(warmstart=jnp.zeros_like(middle.warmstart))
    # Measured: 2e-6 at most, the float32 in the middle; without the warm start, a median of 3e-2.
    assert relative_error(at_once.qvel, step(middle, controls).qvel).max() < 1e-4
    assert np.median(relative_error(at_once.qvel, step(dropped, controls).qvel)) > 1e-2


@pytest.mark.parametrize("profile", physics.PROFILES)
def test_options_are_those_of_gymnasiums_model(profile):
    path = f"{gymnasium.__path__[0]}/envs/mujoco/assets/ant.xml"
    theirs, ours = (
        mujoco.MjModel.from_xml_path(path).opt,
        physics.load_model("ant.xml", profile).opt,
    )
    names = [name for name in dir(theirs) if not name.startswith("_")]
    differing = {
        name for name in names if not np.array_equal(getattr(ours, name), getattr(theirs, name))
    }
    bounded = {"iterations", "ls_iterations"} if profile == "fast" else set()
    assert differing == {"disableflags"} | bounded
    assert ours.disableflags == theirs.disableflags | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert ours.iterations <= theirs.iterations and ours.ls_iterations <= theirs.ls_iterations


def test_tracing_mjx_leaves_its_colliders_as_they_were():
    colliders = collision_driver._COLLISION_FUNC
    before = dict(colliders)
    with pytest.raises(RuntimeError), physics._capsule_frames():
        assert colliders != before
        raise RuntimeError
    assert colliders == before
