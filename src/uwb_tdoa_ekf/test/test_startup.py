from covariances import assert_covariance
from flights import GRAVITY, corners
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.ground import KnownHeight
from uwb_tdoa_ekf.core.memory import TDOA, new_state, structured
from uwb_tdoa_ekf.core.startup import Places, level, locate, split
from uwb_tdoa_ekf.core.workspace import set_bounds

SIZE = np.array([7.0, 8.0, 3.0])
STD = 0.25  # m, what locate is told of one TDOA


def constellation(n, rng):
    """(n, 3) positions in the room: four corners that form a tetrahedron, the eight corners, then
    anywhere.
    """
    corner = np.array(corners().positions)
    chosen = [0, 3, 5, 6] + [1, 2, 4, 7]
    return np.concatenate([corner[chosen], rng.uniform(0.0, 1.0, (max(n - 8, 0), 3)) * SIZE])[:n]


def window(rng, positions, p, v, n=100, std=0.0, outliers=0.0, anchor_std=0.0, length=0.5):
    """n TDOAs of random pairs over `length` s, at whose end the tag is at p with velocity v."""
    t = np.sort(rng.uniform(0.0, length, n))
    a = rng.integers(0, len(positions), n)
    b = (a + rng.integers(1, len(positions), n)) % len(positions)
    late = anchor_std * rng.standard_normal(len(positions))
    d = tdoa(p + (t - t[-1])[:, None] * v, positions[a], positions[b]) + late[b] - late[a]
    d += std * rng.standard_normal(n)
    wrong = rng.random(n) < outliers
    return t, a, b, d + np.where(wrong, rng.choice([-1.0, 1.0], n) * rng.uniform(1.0, 5.0, n), 0.0)


def window_of(t, a, b, d):
    return structured(TDOA, t, a, b, d, np.zeros(len(t)))


def places(tdoas, positions, count=2, std=STD):
    """(x (count, 6), covariance (count, 6, 6), cost (count,), share) as of `locate`."""
    found, workspace = (
        Places(np.empty((count, 6)), np.empty((count, 6, 6)), np.empty(count)),
        np.empty((2, 3)),
    )
    state, parameters = new_state(positions), FilterConfig(tdoa_std=std).parameters()[0]
    set_bounds(state.record.extent, 1.0, workspace)
    share = locate(
        window_of(*tdoas), state.anchors, workspace, parameters, KnownHeight(np.nan, np.nan), found
    )
    return *found, share


def located(tdoas, positions):
    x, covariance, _, share = places(tdoas, positions, count=1)
    return x[0], covariance[0], share


def errors(n, count, speed=0.0, seed=0, **kind):
    """Position errors (count,) m, and shares of agreeing TDOAs, for tags anywhere inside."""
    rng = np.random.default_rng([seed, n])
    off, shares = [], []
    for _ in range(count):
        positions, v = constellation(n, rng), rng.standard_normal(3)
        p = rng.uniform(0.15, 0.85, 3) * SIZE
        x, covariance, share = located(
            window(rng, positions, p, speed * v / np.linalg.norm(v), **kind), positions
        )
        assert_covariance(covariance)
        off.append(np.linalg.norm(x[:3] - p))
        shares.append(share)
    return np.array(off), np.array(shares)


@pytest.mark.parametrize("n", [4, 6, 8, 64])
@pytest.mark.parametrize(
    ("kind", "median", "largest", "share"),
    [
        ({}, 0.1, 0.1, 1.0),
        # the prior of 1 m/s per axis holds the velocity back, by half of the path at most
        ({"speed": 1.0}, 0.3, 0.3, 1.0),
        ({"speed": 0.5, "std": 0.1}, 0.12, 0.3, 1.0),
        ({"std": 0.1, "outliers": 0.3}, 0.1, 0.3, 0.7),
    ],
)
def test_a_tag_is_found_and_how_many_tdoas_agree(n, kind, median, largest, share):
    off, shares = errors(n, 60, **kind)
    assert np.median(off) < median and off.max() < largest
    assert (shares == 1.0).all() if share == 1.0 else abs(shares.mean() - share) < 0.03


def test_anchors_on_a_wall_leave_two_places_and_no_others():
    rng = np.random.default_rng(3)
    for _ in range(20):
        positions = constellation(16, rng)
        positions[:, 0] = 0.0
        p = np.array([2.0, 4.0, 1.5]) + rng.uniform(-0.5, 0.5, 3)
        x, _, cost, _ = places(window(rng, positions, p, np.zeros(3)), positions, 3)
        np.testing.assert_allclose(sorted(x[:2, 0]), [-p[0], p[0]], atol=0.1)
        assert cost[0] == 0.0 and cost[1] < 0.1
        if np.isfinite(cost[2]):  # on the wall between them
            assert abs(x[2, 0]) < 0.1 and cost[2] > cost[1]


def test_anchors_all_around_leave_one_place():
    rng = np.random.default_rng(4)
    for _ in range(20):
        positions, p = constellation(8, rng), rng.uniform(0.15, 0.85, 3) * SIZE
        assert places(window(rng, positions, p, np.zeros(3)), positions)[2][1] == np.inf


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_place_is_split_along_its_principal_axis_whichever_that_is(seed, normal):
    """normal : the axis is normal to (1, 1, 1), where a power iteration may have begun."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    axis -= normal * axis.mean()
    basis, _ = np.linalg.qr(np.column_stack([axis, rng.standard_normal((3, 2))]))
    whole = np.eye(6)
    whole[:3, :3] = basis @ np.diag([9.0, 0.5, 0.3]) @ basis.T
    x, covariance, cost = np.zeros((2, 6)), np.array([whole, whole]), np.array([0.0, np.inf])
    split(Places(x, covariance, cost))
    apart = x[1, :3] - x[0, :3]
    assert (
        abs(apart @ basis[:, 0]) == pytest.approx(np.linalg.norm(apart), rel=1e-6)
        and np.linalg.norm(apart) > 3.0
    )
    for each in covariance:
        assert_covariance(each)


def test_a_place_that_is_known_is_not_split():
    x, covariance, cost = np.zeros((2, 6)), np.array([np.eye(6) * 0.5] * 2), np.array([0.0, np.inf])
    split(Places(x, covariance, cost))
    assert cost[1] == np.inf and not x.any()


def test_few_anchors_in_one_plane_say_how_little_they_tell():
    rng, seen = np.random.default_rng(2), []
    for _ in range(100):
        around = 2.0 * np.pi * (np.arange(8) + rng.uniform(0.0, 0.7, 8)) / 8
        positions = np.stack(
            [3.5 + 3.5 * np.cos(around), 4.0 + 4.0 * np.sin(around), np.full(8, 3.0)], axis=1
        )
        p = (
            np.array([3.5, 4.0, 0.0])
            + rng.uniform(-1.5, 1.5, 3) * [1, 1, 0]
            + [0, 0, rng.uniform(0.5, 3.0)]
        )
        x, covariance, _ = located(window(rng, positions, p, np.zeros(3), std=0.1), positions)
        side = np.copysign(1.0, x[2] - 3.0)
        e = x[:3] - [p[0], p[1], 3.0 + side * abs(p[2] - 3.0)]
        seen.append(e @ np.linalg.solve(covariance[:3, :3], e))
    assert np.mean(seen) < 3.0


@pytest.mark.parametrize("n", [8, 16])
def test_covariance_is_honest_when_errors_persist_over_the_window(n):
    """Errors of the anchors, of the size that locate is told, last for the whole window, as
    measured ones do.
    """
    rng, seen = np.random.default_rng(n), []
    for _ in range(400):
        positions, p, v = (
            constellation(n, rng),
            rng.uniform(0.15, 0.85, 3) * SIZE,
            rng.standard_normal(3),
        )
        tdoas = window(rng, positions, p, v, std=0.03, anchor_std=STD / np.sqrt(2.0))
        x, covariance, _ = located(tdoas, positions)
        e = x - np.concatenate([p, v])
        seen.append(
            [e @ np.linalg.solve(covariance, e), e[:3] @ np.linalg.solve(covariance[:3, :3], e[:3])]
        )
    whole, position = np.mean(seen, axis=0)
    print(f"{n} anchors: mean NEES {whole:.2f} of 6, position {position:.2f} of 3")
    assert 6.0 / 3.0 < whole < 6.5 and 3.0 / 3.0 < position < 3.5


def test_two_anchors_do_not_break_it():
    positions = np.array([[0.0, 0.0, 0.0], [7.0, 0.0, 0.0]])
    rng = np.random.default_rng(0)
    x, covariance, _ = located(
        window(rng, positions, np.array([2.0, 1.0, 1.0]), np.zeros(3), n=12), positions
    )
    assert np.isfinite(x).all()
    assert_covariance(covariance)
    assert covariance[1, 1] > 1.0  # it knows that it does not know


@given(st.integers(0, 2**32 - 1))
def test_nonsense_gives_a_finite_position_and_a_covariance(seed):
    rng = np.random.default_rng(seed)
    positions = constellation(int(rng.integers(4, 20)), rng)
    t, a, b, _ = window(rng, positions, np.zeros(3), np.zeros(3), n=int(rng.integers(12, 60)))
    x, covariance, share = located((t, a, b, rng.uniform(-12.0, 12.0, len(t))), positions)
    assert np.isfinite(x).all() and 0.0 <= share <= 1.0
    assert_covariance(covariance)
    level(np.zeros(3), 0.0, flat := np.zeros(16))
    assert flat[6:10].tolist() == [0, 0, 0, 1]


@given(st.integers(0, 2**32 - 1))
def test_level_makes_the_specific_force_point_up_and_keeps_the_yaw(seed):
    rng = np.random.default_rng(seed)
    yaw, pitch, roll = rng.uniform([-np.pi, -1.5, -np.pi], [np.pi, 1.5, np.pi])
    true = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    x = np.zeros(16)
    level(true.inv().apply([0.0, 0.0, GRAVITY]), yaw, x)
    assert (true.inv() * Rotation.from_quat(x[6:10])).magnitude() < 1e-7
    assert abs(np.linalg.norm(x[6:10]) - 1.0) < 1e-12


def test_halves_of_a_place_whose_velocity_is_correlated_have_covariances():
    """Before, the velocity stayed what it was, and the filter became no number."""
    x, covariance, cost = np.zeros((2, 6)), np.zeros((2, 6, 6)), np.array([0.0, np.inf])
    row = np.concatenate([np.eye(3), 0.9 * np.eye(3)], axis=1)
    covariance[0] = 9.0 * row.T @ row + 0.1 * np.eye(6) + np.diag([5.0, 0, 0, 0, 0, 0])
    whole = covariance[0].copy()
    split(Places(x, covariance, cost))
    np.testing.assert_allclose(covariance[0] + np.outer(x[0], x[0]), whole)
    for each in covariance:
        assert_covariance(each)
