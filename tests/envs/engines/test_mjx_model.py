"""What a kept program of a MuJoCo scene is found by: whatever changes the loss is in it."""

import itertools
from dataclasses import replace

import pytest

import gradscape as gs
from gradscape.envs.engines.mjx.model import Course, Model, Settings
from gradscape.envs.mjx.scenes import Drop

SCENE = """
<mujoco>
  <include file="ball.xml"/>
  <asset><mesh name="pebble" file="pebble.obj"/></asset>
  <worldbody><geom type="mesh" mesh="pebble"/></worldbody>
</mujoco>
"""
BALL = '<mujoco><worldbody><body name="ball"><freejoint/><geom size="{radius}"/></body></worldbody></mujoco>'
PEBBLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {height}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
COURSE = Course((("qvel", (0,)),), segments=1, held=1, steps=100, act=print)
SETTINGS = Settings(dt=0.01, solver="newton", iterations=0, ls_iterations=0)


def test_an_edited_include_or_asset_and_another_setting_or_course_is_another_model(tmp_path):
    scene, ball, pebble = (tmp_path / name for name in ("scene.xml", "ball.xml", "pebble.obj"))
    scene.write_text(SCENE)
    ball.write_text(BALL.format(radius=0.1))
    pebble.write_text(PEBBLE.format(height=1.0))

    def identity(settings=SETTINGS, course=COURSE, precision="float64", *others):
        return Model(str(scene), settings, precision, name="scene").identify(course, *others)

    first = identity()
    assert first
    assert identity(course=replace(COURSE, act=repr)) == first  # what is called is code, of which there is a digest
    found = [first, identity(precision="float32"), identity(SETTINGS, COURSE, "float64", "another option")]
    found += [identity(replace(SETTINGS, **{name: 3})) for name in ("dt", "iterations", "ls_iterations")]
    found += [identity(replace(SETTINGS, solver="cg")), identity(course=replace(COURSE, steps=99))]
    found += [identity(course=replace(COURSE, places=(("qvel", (1,)),)))]
    ball.write_text(BALL.format(radius=0.2))
    found.append(identity())
    pebble.write_text(PEBBLE.format(height=0.9))
    found.append(identity())
    same = [(i, j) for (i, one), (j, other) in itertools.combinations(enumerate(found), 2) if one == other]
    assert not same


def test_a_scene_of_ours_is_found_by_what_its_loss_depends_on():
    made = [gs.make(name, device="cpu") for name in ("mjx-drop", "mjx-bounce", "mjx-cartpole")]
    options = ({"fidelity": "standard"}, {"iterations": 1}, {"mode": "reverse"}, {"horizon": 0.5})
    made += [gs.make("mjx-drop", device="cpu", **one) for one in options]
    keys = [scene._function.key for scene in made]
    assert "" not in keys
    assert len(set(keys)) == len(keys)
    assert gs.make("mjx-drop", device="cpu")._function.key == keys[0]


def test_of_a_scene_with_code_of_somebodys_only_an_episode_of_ours_is_found(monkeypatch):
    """What such code reads nobody knows: constants of a module, files, the time."""
    pytest.importorskip("mujoco.mjx")
    mine = type("Mine", (Drop,), {"loss_of": lambda self, state: state.qpos[2]})()
    assert mine._key == mine._function.key == Drop()._key
    moved = type("Mine", (Drop,), {"act": lambda self, model, state, control: state})()
    assert moved._key == moved._function.key == ""
    reverse = type("Mine", (Drop,), {})(mode="reverse")
    assert reverse._function.key == ""
    whole = Drop()._function.key
    monkeypatch.setattr(Drop, "loss_of", lambda self, state: state.qpos[2])
    assert Drop()._function.key not in (whole, "")
    monkeypatch.setattr(Drop, "act", lambda self, model, state, control: state)
    assert Drop()._function.key == ""
