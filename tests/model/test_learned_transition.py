"""Test the learned transition: invariance, its network and its step against float64, its noise, its files."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.dynamics.transitions import random_planar, random_transition
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.model.transition import RIGID, GaussianBelief, Imu, Planar, RigidState
from vssm_gym.model.transition.bicycle import Bicycle
from vssm_gym.model.transition.calibrated import CalibratedDrive, CalibratedImu, ImuConstants
from vssm_gym.model.transition.learned import LearnedTransition, Scales, together, untrained
from vssm_gym.model.transition.learned_file import NOMINALS, calibrated, load_transition, save_transition
from vssm_gym.model.transition.residual_network import new_network
from vssm_gym.model.transition.with_rest import RestState

DT = 0.1  # s
CONTROL = jnp.array([0.3, -0.5, 9.6, 0.4, -0.2, 0.7])


def f32(a):
    return jnp.asarray(a, jnp.float32)


def flying(seed: int = 0) -> RigidState:
    rng = np.random.default_rng(seed)
    return RigidState(se3_exp(f32(rng.normal(size=6))), f32(rng.normal(size=6)))


def moved(state: RigidState, yaw: float, shift: np.ndarray) -> RigidState:
    """Return the state in a world that is turned about the vertical and shifted."""
    G = np.eye(4)
    G[:3, :3], G[:3, 3] = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix(), shift
    velocity = np.asarray(state.velocity, float).reshape(2, 3) @ G[:3, :3].T
    return RigidState(f32(G) @ state.T_world_body, f32(velocity.ravel()))


@pytest.mark.parametrize("yaw", [0.7, np.pi, -2.0])
def test_neither_place_nor_yaw_matters_in_space(yaw):
    """``mean``, covariance and density commute with every motion of the world that keeps gravity."""
    learned, shift = random_transition(), np.array([3.0, -20.0, 5.0])
    rest = f32([0.4, -0.3])
    here, there = (learned.mean(RestState(s, rest), CONTROL, DT) for s in (flying(), moved(flying(), yaw, shift)))
    expected = moved(here.body, yaw, shift)
    np.testing.assert_allclose(there.body.T_world_body, expected.T_world_body, atol=1e-5)
    np.testing.assert_allclose(there.body.velocity, expected.velocity, atol=2e-5)
    np.testing.assert_allclose(there.rest, here.rest, atol=1e-5)
    following = learned.sample(jax.random.key(1), RestState(flying(), rest), CONTROL, DT)
    log_p = learned.log_prob(following, RestState(flying(), rest), CONTROL, DT)
    following = RestState(moved(following.body, yaw, shift), following.rest)
    again = learned.log_prob(following, RestState(moved(flying(), yaw, shift), rest), CONTROL, DT)
    np.testing.assert_allclose(float(again), float(log_p), rtol=1e-3)


def test_neither_place_nor_heading_matters_on_the_floor():
    learned, u = random_planar(), f32([0.1, 0.05, 0.12])
    start = RestState(jnp.zeros(3), f32([0.3, -0.2]))
    here = learned.mean(start, u, DT)
    there = learned.mean(RestState(f32([2.0, -1.0, 2.5]), start.rest), u, DT)
    c, s = np.cos(2.5), np.sin(2.5)
    x, y, heading = np.asarray(here.body)
    np.testing.assert_allclose(there.body, [2.0 + c * x - s * y, -1.0 + s * x + c * y, 2.5 + heading], atol=1e-5)
    np.testing.assert_allclose(there.rest, here.rest, atol=1e-6)


def test_tilt_matters():
    """The vertical is seen: a body that is rolled is corrected otherwise."""
    learned = random_transition()
    rolled = np.eye(4)
    rolled[:3, :3] = Rotation.from_rotvec([0.5, 0.0, 0.0]).as_matrix()
    steps = [
        learned.step(learned.start(RigidState(f32(T), jnp.zeros(6))), CONTROL, DT).mean.rest
        for T in (np.eye(4), rolled)
    ]
    assert np.abs(np.asarray(steps[0] - steps[1])).max() > 1e-3


def test_a_network_that_says_nothing_leaves_the_nominal_step():
    scales = Scales(jnp.zeros(15), jnp.ones(15), jnp.full(12, 0.1), jnp.asarray(DT))
    learned = untrained(jax.random.key(0), Imu(), scales)
    after = learned.mean(learned.start(flying()), CONTROL, DT)
    expected = Imu().mean(flying(), CONTROL, DT)
    np.testing.assert_allclose(after.body.T_world_body, expected.T_world_body, atol=1e-6)
    np.testing.assert_allclose(after.body.velocity, expected.velocity, atol=1e-6)
    np.testing.assert_array_equal(after.rest, 0.0)


def test_the_network_agrees_with_numpy():
    """``y = A x + B h_n + c``, by hand in float64."""
    rng, network = np.random.default_rng(0), new_network(jax.random.key(3), 4, 3, 8, 3)
    leave, linear, offset = (f32(rng.normal(size=a.shape)) for a in (network.leave, network.linear, network.offset))
    network = eqx.tree_at(lambda n: (n.leave, n.linear, n.offset), network, (leave, linear, offset))
    x = rng.normal(size=(5, 4))
    h = np.maximum(x @ np.asarray(network.enter, float), 0.0)
    for W, b in zip(*(np.asarray(a, float) for a in network.layers), strict=True):
        h = h + np.maximum(h @ W + b, 0.0)
    expected = h @ np.asarray(leave, float) + x @ np.asarray(linear, float) + np.asarray(offset, float)
    np.testing.assert_allclose(network(f32(x)), expected, atol=1e-5)


def test_prediction_agrees_with_samples():
    """``F P F^T + Q`` of a narrow belief, pose, velocity and rest, against 40,000 draws through the step."""
    learned, count = random_transition(spread=0.1), 40_000
    n = len(learned.manifold.turns)
    root = np.random.default_rng(1).normal(size=(n, n)) * 0.02 / np.sqrt(n)
    belief = GaussianBelief(RestState(flying(), f32([0.2, -0.1])), f32(root @ root.T), learned.manifold)
    predicted = learned.predict(belief, CONTROL, DT)
    drawn = belief.sample(jax.random.key(0), count)
    after = eqx.filter_jit(learned.sample)(jax.random.key(1), drawn, jnp.broadcast_to(CONTROL, (count, 6)), DT)
    xi = np.asarray(learned.manifold.error(predicted.mean, after), float)
    spread = np.sqrt(np.diag(np.asarray(predicted.covariance, float)))
    assert (np.abs(xi.mean(axis=0)) < 0.05 * spread).all()
    expected = np.asarray(predicted.covariance, float) / np.outer(spread, spread)
    np.testing.assert_allclose(np.cov(xi.T) / np.outer(spread, spread), expected, atol=0.04)


def test_the_noise_depends_on_the_state():
    learned = random_transition()
    slow, fast = (RigidState(jnp.eye(4), f32([v, 0.0, 0.0, 0.0, 0.0, 0.0])) for v in (0.0, 4.0))
    stds = [np.asarray(learned.step(learned.start(state), CONTROL, DT).stds) for state in (slow, fast)]
    assert np.abs(np.log(stds[0] / stds[1])).max() > 0.1


def test_errors_in_body_axes_are_inverse():
    learned, e = random_transition(), f32(np.random.default_rng(2).normal(size=14) * 0.3)
    state = RestState(flying(3), f32([0.1, 0.2]))
    again = learned.error_in_body_axes(state, learned.perturb_in_body_axes(state, e))
    np.testing.assert_allclose(again, e, atol=1e-5)


def test_a_longer_step_is_corrected_more():
    """Corrections are proportional to ``dt``, variances too."""
    learned, state = random_transition(), RestState(flying(), f32([0.1, 0.0]))
    short, long = (learned.step(state, CONTROL, dt) for dt in (0.05, 0.1))
    np.testing.assert_allclose(np.asarray(long.stds**2), 2.0 * np.asarray(short.stds**2), rtol=1e-5)
    changes = [np.asarray(step.mean.rest - state.rest) for step in (short, long)]
    np.testing.assert_allclose(changes[1], 2.0 * changes[0], rtol=1e-4, atol=1e-6)


# --- several networks


def ensemble(count: int = 3, size: int = 2) -> LearnedTransition:
    """Return networks with other weights, in the same units."""
    first = random_transition(size=size)
    others = [random_transition(size=size, seed=seed).network for seed in range(1, count)]
    return together([first, *(eqx.tree_at(lambda t: t.network, first, network) for network in others)])


def test_equal_networks_are_as_one():
    """Whatever their weights, pose and spread are those of one, and each rest moves as that of one."""
    one = random_transition()
    three = together([one] * 3)
    assert (three.members, three.rest, len(three.manifold.turns)) == (3, 9, 21)
    rest, b = f32([0.2, -0.1]), f32([0.7, -1.2, 0.4])
    alone = one.step(RestState(flying(), rest), CONTROL, DT)
    joint = three.step(RestState(flying(), jnp.concatenate([rest, rest, rest, b])), CONTROL, DT)
    np.testing.assert_allclose(joint.mean.body.T_world_body, alone.mean.body.T_world_body, atol=1e-5)
    np.testing.assert_allclose(joint.mean.body.velocity, alone.mean.body.velocity, atol=1e-5)
    np.testing.assert_allclose(joint.mean.rest, [*np.tile(alone.mean.rest, 3), *b], atol=1e-5)
    np.testing.assert_allclose(joint.stds[:12], alone.stds[:12], rtol=1e-5)
    np.testing.assert_allclose(joint.stds[12:18], np.tile(alone.stds[12:], 3), rtol=1e-5)


def test_a_rest_of_zero_gives_the_mean_of_the_networks():
    joint, state = ensemble(), flying()
    networks = [jax.tree.map(lambda a, k=k: a[k], joint.network) for k in range(3)]
    alone = [LearnedTransition(joint.nominal, network, joint.scales, joint.size) for network in networks]
    steps = [member.step(member.start(state), CONTROL, DT) for member in alone]
    nominal = joint.nominal.mean(state, CONTROL, DT)
    xi = [RIGID.error(nominal, step.mean.body) for step in steps]
    step = joint.step(joint.start(state), CONTROL, DT)
    np.testing.assert_allclose(RIGID.error(nominal, step.mean.body), np.mean(xi, axis=0), atol=1e-5)
    squares = [np.asarray(s.stds[:12]) ** 2 for s in steps]
    np.testing.assert_allclose(np.asarray(step.stds[:12]) ** 2, np.mean(squares, axis=0), rtol=1e-4)


def test_weights_have_the_moments_of_a_choice_at_random():
    """Mean 1/K and covariance (1 - 1/K) / K, -1/K^2: those of choosing one of K networks; their sum is one."""
    joint, count = ensemble(), 200_000
    weights = np.asarray(joint._weights(jax.random.normal(jax.random.key(0), (count, joint.rest))), float)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-5)
    chosen = np.eye(3)[np.random.default_rng(0).integers(0, 3, count)]
    np.testing.assert_allclose(weights.mean(axis=0), 1.0 / 3.0, atol=0.005)
    np.testing.assert_allclose(np.cov(weights.T), np.cov(chosen.T), atol=0.005)


def test_less_disagreement_is_less_spread_of_the_weights():
    joint = eqx.tree_at(lambda t: t.disagreement, ensemble(), jnp.asarray(0.5))
    rest = jax.random.normal(jax.random.key(0), (100, joint.rest))
    half, whole = (np.asarray(t._weights(rest)) - 1.0 / 3.0 for t in (joint, ensemble()))
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-6)


def test_several_networks_are_stored_in_a_file(tmp_path):
    joint = together([random_transition(calibrated("imu"), size=3, further=1, seed=4)] * 4)
    save_transition(tmp_path / "a.npz", joint, "imu", {})
    found = load_transition(tmp_path / "a.npz").transition
    assert jax.tree.structure(found) == jax.tree.structure(joint)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(joint), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_file_of_the_first_version_is_read(tmp_path):
    """It has no number of networks: there was one."""
    learned = stored_kinds()["car"]
    save_transition(tmp_path / "a.npz", learned, "car", {})
    with np.load(tmp_path / "a.npz") as stored:
        arrays = {name: np.array(a) for name, a in stored.items()}
    header = json.loads(bytes(arrays["header"])) | {"version": 1}
    del header["members"]
    np.savez(tmp_path / "b.npz", **arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)})
    found = load_transition(tmp_path / "b.npz").transition
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(learned), strict=True):
        np.testing.assert_array_equal(a, b)


# --- constants


def test_the_constants_of_an_imu_agree_with_a_simulation():
    """A body that spins steadily about a fixed point, read by a biased IMU on an arm, stands where it is."""
    lever, w = np.array([0.1, -0.05, 0.02]), np.array([0.0, 0.0, 2.0])
    bias_a, bias_w = np.array([0.1, -0.2, 0.05]), np.array([0.01, 0.02, -0.03])
    force = np.array([0.0, 0.0, 9.81]) + np.cross(w, np.cross(w, lever)) + bias_a
    reading = np.concatenate([force, w + bias_w])
    model = CalibratedImu(ImuConstants(f32(bias_a), f32(bias_w), jnp.zeros(3), f32(lever)))
    state = RigidState(jnp.eye(4), f32([0.0, 0.0, 0.0, *w]))
    path = model.mean_path(state, jnp.broadcast_to(f32(reading), (50, 6)), 0.02)
    np.testing.assert_allclose(path.T_world_body[-1, :3, 3], 0.0, atol=1e-3)
    np.testing.assert_allclose(
        path.T_world_body[-1, :3, :3], Rotation.from_rotvec([0.0, 0.0, 2.0]).as_matrix(), atol=1e-4
    )


def test_drag_slows_a_body():
    """``v' = -d v`` for one second."""
    model = CalibratedImu(ImuConstants(jnp.zeros(3), jnp.zeros(3), f32([0.5, 0.0, 0.0]), jnp.zeros(3)))
    state = RigidState(jnp.eye(4), f32([2.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
    hover = jnp.broadcast_to(f32([0.0, 0.0, 9.81, 0.0, 0.0, 0.0]), (1000, 6))
    path = model.mean_path(state, hover, 0.001)
    np.testing.assert_allclose(path.velocity[-1, :2], [2.0 * np.exp(-0.5), 1.0], rtol=1e-3)


def test_a_drive_executes_what_its_gains_make_of_a_command():
    model = CalibratedDrive(Bicycle(), f32(np.diag([0.8, 1.0])), f32([0.0, 0.05]))
    expected = Bicycle().mean(jnp.zeros(3), f32([0.8, 0.15]), DT)
    np.testing.assert_allclose(model.mean(jnp.zeros(3), f32([1.0, 0.1]), DT), expected, atol=1e-6)


# --- files


def stored_kinds():
    return {kind: random_transition(calibrated(kind), size=3, further=1, seed=4) for kind in NOMINALS}


@pytest.mark.parametrize("kind", NOMINALS)
def test_a_file_reads_back(kind, tmp_path):
    learned = stored_kinds()[kind]
    nominal = jax.tree.map(lambda a: a + 0.25 if eqx.is_array(a) else a, learned.nominal)
    learned = eqx.tree_at(lambda t: t.nominal, learned, nominal)
    save_transition(tmp_path / "a.npz", learned, kind, {"updates": 7})
    found = load_transition(tmp_path / "a.npz")
    assert (found.kind, found.trained) == (kind, {"updates": 7})
    assert jax.tree.structure(found.transition) == jax.tree.structure(learned)
    for a, b in zip(jax.tree.leaves(found.transition), jax.tree.leaves(learned), strict=True):
        np.testing.assert_array_equal(a, b)
    save_transition(tmp_path / "b.npz", found.transition, kind, {"updates": 7})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_another_nominal_step_is_refused(tmp_path):
    with pytest.raises(InputError, match="nominal step"):
        save_transition(tmp_path / "a.npz", random_planar(), "holonomic", {})
    assert not (tmp_path / "a.npz").exists()


def damaged(arrays: dict, kind: str) -> dict:
    header = json.loads(bytes(arrays["header"]))
    changed = {
        "version": lambda: header.update(version=3),
        "kind": lambda: header.update(kind="boat"),
        "size": lambda: header.update(size=4000),
        "members": lambda: header.update(members=0),
        "trained": lambda: header.update(trained=3),
        "arrays": lambda: arrays.pop("network.leave"),
        "network.enter": lambda: arrays.update({"network.enter": arrays["network.enter"][:-1]}),
        "network.offset": lambda: arrays["network.offset"].fill(np.nan),
        "scales.spread": lambda: arrays["scales.spread"].fill(0.0),
        "scales.step": lambda: arrays.update({"scales.step": np.float32(-1.0)}),
    }
    changed[kind]()
    return arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}


FIELDS = (
    "version", "kind", "size", "members", "trained", "arrays", "network.enter", "network.offset", "scales.spread",
    "scales.step",
)  # fmt: skip


@pytest.mark.parametrize("field", FIELDS)
def test_a_damaged_file_is_refused_by_name(field, tmp_path):
    save_transition(tmp_path / "a.npz", stored_kinds()["imu"], "imu", {})
    with np.load(tmp_path / "a.npz") as stored:
        arrays = {name: np.array(a) for name, a in stored.items()}
    np.savez(tmp_path / "b.npz", **damaged(arrays, field))
    with pytest.raises(InputError) as caught:
        load_transition(tmp_path / "b.npz")
    assert caught.value.field == field
    assert str(tmp_path / "b.npz") in str(caught.value)


def test_a_cut_file_is_refused(tmp_path):
    save_transition(tmp_path / "a.npz", stored_kinds()["car"], "car", {})
    whole = (tmp_path / "a.npz").read_bytes()
    for share in (0.0, 0.3, 0.9):
        (tmp_path / "b.npz").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError):
            load_transition(tmp_path / "b.npz")
    with pytest.raises(InputError, match="train-dynamics"):
        load_transition(tmp_path / "none.npz")


def test_it_is_a_transition_of_the_nominal_ones_kind():
    rigid, planar = random_transition(further=1), random_planar()
    assert isinstance(rigid, LearnedTransition)
    assert (rigid.controls, rigid.commanded, len(rigid.manifold.turns)) == (7, False, 14)
    assert (planar.controls, planar.commanded, len(planar.manifold.turns)) == (3, True, 5)
    assert isinstance(planar.nominal, Planar)
    belief = planar.belief_at(np.array([1.0, 2.0, 0.3]))
    np.testing.assert_allclose(np.diag(belief.covariance)[3:], 1.0)
