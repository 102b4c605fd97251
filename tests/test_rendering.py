"""Pictures of states: what is seen moves, the choice of OpenGL, videos and strips, mistakes."""

import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import untrained
from PIL import Image

import maxent_jax
from maxent_jax import analysis, components, errors
from maxent_jax.analysis import Paths
from maxent_jax.commands import render
from maxent_jax.config import preset
from maxent_jax.runs import files
from maxent_jax.visual import frames, headless, rendering, video
from maxent_jax.visual.headless import RenderingError

ROOT = Path(__file__).parent.parent
SIZE = 128


@pytest.fixture(scope="module")
def opengl():
    try:
        headless.choose_backend()
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def ant(opengl):
    with rendering.scene(components.make(preset("smoke")), SIZE) as scene:
        yield scene


def rest(env="ant", **positions):
    """The state at rest, some of its positions changed: [D]."""
    env = components.make(preset("smoke", env=env)).env
    state = np.zeros(env.observation_size)
    state[: env.model.nq] = env.model.qpos0
    for name, value in positions.items():
        state[int(name.removeprefix("q"))] = value
    return state


def difference(one, other):
    """Mean over the pixels and colours, of 255."""
    return np.abs(one.astype(float) - other).mean()


def skin(picture):
    """The pixels of the ant, which its XML paints (0.8, 0.6, 0.4): the scenery is grey and blue."""
    red, blue = picture[..., 0].astype(int), picture[..., 2].astype(int)
    return red > blue + 20


def test_the_camera_follows_the_torso(ant):
    for x, y in ((0, 0), (37.3, -12.9), (-250.0, 80.0)):
        rows, columns = np.nonzero(skin(ant.draw(rest(q0=x, q1=y))))
        assert 200 < len(rows) < SIZE**2 / 3
        # The resting ant is symmetrical left to right, and its legs lie around its torso.
        assert abs(columns.mean() - (SIZE - 1) / 2) < 2
        assert abs(rows.mean() - (SIZE - 1) / 2) < SIZE / 10


def test_the_floor_goes_by_and_repeats_every_two_metres(ant):
    """Of squares of 1 m, in two colours, however far: the XML's own floor ends at 40 m."""
    here, half, one, two, far = (ant.draw(rest(q0=x)) for x in (0, 0.5, 1, 2, 100))
    assert difference(here, half) > 2 and difference(here, one) > 4
    assert difference(here, two) < 0.5 and difference(here, far) < 0.5
    assert here[-10:].std() > 5  # the squares are there to be seen


def test_a_joint_moves_the_picture(ant):
    at_rest, bent = ant.draw(rest()), ant.draw(rest(q7=0.5, q8=1.0))
    assert (skin(at_rest) != skin(bent)).sum() > 30
    np.testing.assert_array_equal(at_rest, ant.draw(rest()))  # nothing is left of another state


@pytest.mark.parametrize("env", ["walker2d", "humanoid"])
def test_every_robot_is_seen(opengl, env):
    with rendering.scene(components.make(preset("smoke", env=env)), SIZE) as scene:
        state = rest(env)
        seen = scene.draw(state)
        state[0] += 1000.0
        away = scene.draw(state)
    assert seen.shape == (SIZE, SIZE, 3) and seen.dtype == np.uint8
    assert difference(seen, away) < 0.5  # the camera and the floor went with it
    middle = seen[SIZE // 4 : -SIZE // 4, SIZE // 2 - 3 : SIZE // 2 + 3].astype(int)
    assert (np.ptp(middle, axis=-1) > 40).mean() > 0.2  # its colours are no greys


def test_an_environment_without_positions_is_refused():
    for env in ("pendulum", "mountain_car", "brax:ant"):
        with pytest.raises(RenderingError, match=f"'{env}' cannot be drawn"):
            headless.check_drawable(env)
    headless.check_drawable("user:mine")
    with pytest.raises(RenderingError, match="'pendulum' cannot be drawn"):
        rendering.scene(components.make(preset("smoke", env="pendulum")), SIZE)


@pytest.fixture
def choice(monkeypatch):
    """choose_backend, where only the backends in the list that it is given draw."""

    def choose(*working, set_by_user=None):
        monkeypatch.setattr(headless, "_draws", lambda backend: backend in working)
        monkeypatch.setattr(headless, "BACKENDS", ("egl", "osmesa"))
        monkeypatch.setattr(headless, "READS_VARIABLE", "no_such_module")
        monkeypatch.setenv(headless.VARIABLE, set_by_user or "")
        return headless.choose_backend.__wrapped__()

    return choose


def test_egl_is_tried_before_osmesa_and_the_users_word_counts(choice):
    assert choice("egl", "osmesa") == "egl"
    assert choice("osmesa") == "osmesa"
    assert choice("egl", "osmesa", "glfw", set_by_user="glfw") == "glfw"
    assert choice("egl", "osmesa", set_by_user="osmesa") == "osmesa"


def test_without_opengl_one_sentence_names_the_packages(choice):
    with pytest.raises(RenderingError, match=r"libegl1 .* libosmesa6") as nothing:
        choice()
    with pytest.raises(RenderingError, match=r"MUJOCO_GL is 'glfw'.*libegl1") as not_this:
        choice("egl", set_by_user="glfw")
    assert str(nothing.value).count("\n") == str(not_this.value).count("\n") == 0


def paths_of(lengths):
    """Episodes of one policy that end after so many steps, on their way along x."""
    states = np.tile(rest(), (len(lengths), max(lengths), 1))
    states[..., 0] = np.arange(max(lengths))
    alive = np.arange(max(lengths)) < np.array(lengths)[:, None]
    return Paths(states, alive, np.zeros(len(lengths), int))


def untrained_run():
    run = untrained.make_run(num_iterations=1)
    return dataclasses.replace(run, mixture=run.mixture._replace(size=np.int32(1)))


@pytest.mark.slow
def test_the_episode_of_median_length_is_shown():
    (episode,) = frames.median_episodes(untrained_run(), paths_of([5, 90, 7]))
    assert episode.name == "π0" and episode.weight == 1
    np.testing.assert_array_equal(episode.route[:, 0], np.arange(7))


def test_a_picture_after_the_end_is_the_last_state_faded(ant):
    run = untrained_run()
    episodes = frames.median_episodes(run, paths_of([60]))
    shots = frames.make(run, ant, episodes, speed=None)
    assert shots.high[0] > 59 and shots.low[0] == -shots.high[0]  # the map holds all of it
    early, last, after = (frames.picture(shots, episodes[0], step) for step in (0, 59, 60))
    assert difference(early, last) > 1
    assert after[SIZE // 2 :].mean() > last[SIZE // 2 :].mean() + 15
    np.testing.assert_array_equal(after, frames.picture(shots, episodes[0], 10_000))


def test_a_mosaic_holds_its_pictures_in_rows():
    pictures = [np.full((6, 8, 3), value, np.uint8) for value in (10, 20, 30)]
    sheet = frames.mosaic(pictures, columns=2)
    gap = frames.GAP
    assert sheet.shape == (12 + gap, 16 + gap, 3)
    assert (sheet[:6, :8] == 10).all() and (sheet[:6, 8 + gap :] == 20).all()
    assert (sheet[6 + gap :, :8] == 30).all() and (sheet[6 + gap :, 8 + gap :] == 255).all()


def test_stills_run_from_the_first_step_to_the_last():
    assert frames.stills(1001, 5) == [0, 250, 500, 750, 1000]
    assert frames.stills(1, 3) == [0, 0, 0]


@pytest.mark.slow
def test_a_run_is_filmed(opengl, copy_of_smoke_run, capsys):
    directory = copy_of_smoke_run
    options = ("--size", SIZE, "--stills", 3, "--speed", 4, "--episodes", 1, "--seed", 3)
    render.main([str(directory), *map(str, options)])
    videos = directory / "videos"
    names = {"mixture", "policy_0", "policy_1", "policy_2"}
    assert {path.name for path in videos.iterdir()} == {
        f"{name}.{kind}" for name in names for kind in ("mp4", "png")
    }
    assert "4 videos" in capsys.readouterr().out
    lengths = maxent_jax.load_run(directory).rollout(1, 3).alive.sum(axis=1)
    for i, length in enumerate(lengths):
        # Ant steps 0.05 s; at 4 times the speed 4 steps make one of 20 frames a second.
        count, seconds = imageio_ffmpeg.count_frames_and_secs(videos / f"policy_{i}.mp4")
        assert count == -(-length // 4)
        assert seconds == pytest.approx(count / 20, abs=0.051)
    count, _ = imageio_ffmpeg.count_frames_and_secs(videos / "mixture.mp4")
    assert count == -(-lengths.max() // 4)
    half, gap = SIZE // 2, frames.GAP
    assert size_of(videos / "policy_1.png") == (3 * half + 2 * gap, half)
    assert size_of(videos / "mixture.png") == (3 * half + 2 * gap, 3 * half + 2 * gap)


def size_of(path):
    with Image.open(path) as image:
        return image.size


@pytest.mark.slow
def test_one_policy_is_filmed_alone(opengl, copy_of_smoke_run):
    directory = copy_of_smoke_run
    render.main([str(directory), "--policy", "2", "--size", "128", "--speed", "50"])
    assert {path.name for path in (directory / "videos").iterdir()} == {
        "policy_2.mp4",
        "policy_2.png",
    }


def test_a_video_that_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / "folder.mp4").mkdir()
    frames = iter([np.zeros((16, 16, 3), np.uint8)])
    with pytest.raises(OSError, match="folder"):
        video.write(tmp_path / "folder.mp4", frames, 20.0)


def test_without_ffmpeg_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(errors.UsageError, match="pip install imageio-ffmpeg"):
        video.check()


@pytest.mark.parametrize(
    ("env", "arguments", "words"),
    [
        ("pendulum", (), "'pendulum' cannot be drawn"),
        ("brax:halfcheetah", (), "'brax:halfcheetah' cannot be drawn"),
        ("ant", ("--policy", "3"), "policies 0 to 2"),
        ("ant", ("--policy", "-1"), "policies 0 to 2"),
        ("ant", ("--episodes", "0"), "--episodes is 0, but must be at least 1"),
        ("ant", ("--stills", "0"), "--stills is 0, but must be from 1"),
        ("ant", ("--size", "130"), "--size is 130, but must be a multiple of 4"),
        ("ant", ("--speed", "nan"), "--speed is nan, but must be from"),
        ("ant", ("--seed", "-1"), "--seed is -1, but must be 0 or more"),
        ("ant", ("--spead", "1"), "did you mean --speed"),
    ],
)
def test_a_mistake_is_one_sentence_at_once(tmp_path, env, arguments, words):
    files.write_config(tmp_path, preset("smoke", env=env), {}, {})
    assert words in refused(tmp_path, *arguments)


def test_a_missing_directory_is_named(tmp_path):
    assert "is not the directory of a run" in refused(tmp_path / "nowhere")


def test_a_backend_that_does_not_draw_is_named(tmp_path, monkeypatch):
    files.write_config(tmp_path, preset("smoke"), {}, {})
    monkeypatch.setenv("MUJOCO_GL", "osmessa")
    assert "MUJOCO_GL is 'osmessa'" in refused(tmp_path)


def refused(*arguments):
    """What render says on standard error before it ends with 2."""
    line = [sys.executable, "-m", "experiments.render", *map(str, arguments)]
    started = time.monotonic()
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert time.monotonic() - started < 3
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    return done.stderr


def test_an_unfinished_run_has_fewer_policies_than_planned(opengl, tmp_path, monkeypatch):
    run = untrained_run()
    files.write_config(tmp_path, run.config, {}, {})
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    monkeypatch.setattr(analysis, "load_run", lambda *_: run)
    with pytest.raises(errors.UsageError, match="policies 0 to 0"):
        render.main([str(tmp_path), "--policy", "1"])
