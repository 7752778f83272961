"""MuJoCo in the benchmarks: its scenes have our dynamics and contacts, and its runs are its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, mass_matrix
from pbfd_torch.bench import mujoco_runs, mujoco_scenes
from pbfd_torch.bench.precision_scenes import CASES
from pbfd_torch.bench.precision_tracks import Track
from pbfd_torch.errors import InputError
from pbfd_torch.models import SCENES, Setup, boxes, chains
from pbfd_torch.terms.contact import Contact
from pbfd_torch.tree.kinematics import place, retract

OURS = mujoco_scenes.NAMES[: -len(mujoco_scenes.ROBOTS)]  # whose MJCF is written here
MU = {"chain-ground": 0.5, "chain-slope": chains.SLOPE_FRICTION, "chain-slope-drop": chains.SLOPE_FRICTION}


def near(setup: Setup, count: int = 4) -> tuple[Tensor, Tensor]:
    """Random states around the scene's start."""
    random = torch.Generator().manual_seed(3)
    a = setup.scene.articulation
    turn, v = torch.randn(2, count, a.nv, dtype=torch.float64, generator=random)
    return retract(a, setup.q[:1].expand(count, -1), 0.7 * turn), v


def data_of(model: Any, q: Tensor, v: Tensor) -> Any:
    """MuJoCo's data after the forward pass."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q.numpy(), v.numpy()
    mujoco.mj_forward(model, data)
    return data


# Scenes -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OURS)
def test_mjcf_has_our_dynamics(name: str) -> None:
    """Start, mass matrix, bias force with gravity, and energy, at random states."""
    setup, model = SCENES[name](worlds=1), mujoco_runs.loaded(name, 0.01, "Euler")
    a, gravity = setup.scene.articulation, setup.scene.gravity
    np.testing.assert_allclose(model.qpos0, setup.q[0].numpy(), atol=1e-15)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    for q, v in zip(*near(setup), strict=True):
        data = data_of(model, q, v)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(mass_matrix(a, q).numpy(), full, atol=1e-12)
        np.testing.assert_allclose(bias_force(a, q, v, gravity).numpy(), data.qfrc_bias, atol=1e-11)
        track = Track.of_states(setup.scene, torch.zeros(1), q[None, None], v[None, None])
        assert float(track.energy) == pytest.approx(float(sum(data.energy)), abs=1e-11)
        np.testing.assert_allclose(track.center[0, 0].numpy(), data.subtree_com[0], atol=1e-12)


@pytest.mark.parametrize("name", ["chain-ground", "chain-slope", "chain-slope-drop", "box-slide"])
def test_mjcf_has_our_contacts(name: str) -> None:
    """The deepest sphere is as deep as our deepest point, with the friction of each world."""
    setup = SCENES[name](worlds=5)
    contact = next(term for term in setup.scene.terms if isinstance(term, Contact))
    q, v = near(setup)
    depth = contact.depth(place(setup.scene.articulation, q[:, None].expand(-1, setup.worlds, -1))).amax(-1)[:, 0]
    q[:, 2] += depth - 0.005  # 5 mm deep
    for world in range(setup.worlds):
        model = mujoco_runs.loaded(name, 0.01, "RK4", world)
        mu = MU.get(name, boxes.SLIDING_FRICTION[world])
        for row, speed in zip(q, v, strict=True):
            data = data_of(model, row, speed)
            assert float(data.contact.dist.min()) == pytest.approx(-0.005, abs=1e-9)
            assert data.contact.friction[:, 0] == pytest.approx(mu)
            assert data.contact.solref[0] == pytest.approx([0.02, 1.0])


@pytest.mark.parametrize("name", mujoco_scenes.LOOSE)
def test_loose_bodies_have_our_shapes(name: str) -> None:
    """As far as each reaches along every axis, where it starts; friction; any two may touch each other, and the ground."""
    setup = SCENES[name]()
    model = mujoco_runs.loaded(name, 0.01, "discrete")
    data = data_of(model, setup.q[0], setup.v[0])
    poses = place(setup.scene.articulation, setup.q[0]).poses.numpy()
    ours, friction = [], [0.0]
    for pose, collider in zip(poses, setup.scene.colliders, strict=True):
        points, radii = collider.shape.candidates()
        reach = (points @ pose[:3, :3].T + radii[:, None]).max(0)
        ours.append(reach + pose[:3, 3])
        friction.append(collider.friction)
    theirs = []
    for k in range(1, model.ngeom):
        turn, size = data.geom_xmat[k].reshape(3, 3), model.geom_size[k]
        if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_MESH:
            first = model.mesh_vertadr[model.geom_dataid[k]]
            vertices = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[k]]]
            reach = (vertices @ turn.T).max(0)
        else:
            reach = size[:1] if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_SPHERE else np.abs(turn) @ size
        theirs.append(reach + data.geom_xpos[k])
    np.testing.assert_allclose(theirs, ours, atol=1e-6)  # vertices are in single precision there
    friction[0] = setup.scene.obstacles[0].friction
    np.testing.assert_array_equal(model.geom_friction[:, 0], friction)
    assert (model.geom_contype == 1).all()
    assert (model.geom_conaffinity == 1).all()


def test_height_field_is_our_terrain() -> None:
    """Its heights are those of the mesh, where a ray from above meets it: the field is not mirrored, and its floor is as deep."""
    setup = SCENES["mesh-terrain"]()
    model = mujoco_runs.loaded("mesh-terrain", 0.01, "discrete")
    away = setup.q[0].clone()
    away[2::7] += 100.0
    data = data_of(model, away, setup.v[0])
    for x, y in ((0.7, -1.2), (-1.3, 0.4), (1.9, 1.9)):  # at vertices
        met = mujoco.mj_ray(model, data, np.array([x, y, 2.0]), np.array([0.0, 0.0, -1.0]), None, 1, -1, np.zeros(1, np.int32))
        assert 2.0 - met == pytest.approx(0.15 * np.sin(2 * x) * np.cos(1.5 * y), abs=1e-6)
    assert model.hfield_size[0] == pytest.approx([2.0, 2.0, model.hfield_size[0, 2], 0.5 + float(model.geom_pos[0, 2])])


def test_settings_and_bad_names() -> None:
    """Time step and integrator are set; robots keep their contacts' time constant."""
    model = mujoco_runs.loaded("hopper", 0.004, "implicitfast")
    assert model.opt.timestep == 0.004
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert (model.geom_solref[:, 0] == 0.02).all()
    with pytest.raises(InputError, match="no MJCF of the scene 'stack': must be one of chain-fixed"):
        mujoco_scenes.mjcf("stack")
    assert {*CASES, *mujoco_scenes.LOOSE, *mujoco_scenes.ROBOTS} == set(mujoco_scenes.NAMES)


# Runs ---------------------------------------------------------------------------------------------------------------------


def test_run_is_mujocos_own_loop() -> None:
    """The states are those of mj_step, control included."""
    case, dt = CASES["hopper"], 0.01
    setup = case.setup(1)
    model = mujoco_runs.loaded("hopper", dt, "Euler")
    controls = case.controls(dt, dt * torch.arange(20, dtype=torch.float64))
    assert controls is not None
    found = mujoco_runs.run(model, setup.q[0], setup.v[0], 20, controls)
    data = mujoco.MjData(model)
    for k in range(20):
        np.testing.assert_array_equal(found.q[k].numpy(), data.qpos)
        np.testing.assert_array_equal(found.v[k].numpy(), data.qvel)
        data.ctrl[:] = controls[k].numpy()
        mujoco.mj_step(model, data)
    assert not found.diverged
    assert found.seconds > 0
    assert float(controls.abs().max()) <= 0.1


def test_divergence_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Euler on the hung-up chain at 20 ms; nothing is written."""
    monkeypatch.chdir(tmp_path)
    setup = SCENES["chain-fixed"]()
    found = mujoco_runs.run(mujoco_runs.loaded("chain-fixed", 0.02, "Euler"), setup.q[0], setup.v[0], 50)
    assert found.diverged
    assert found.q.shape == (51, 10)
    assert found.q.isnan().all()
    assert list(tmp_path.iterdir()) == []
