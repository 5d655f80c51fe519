# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The C code of a correction equals numpy and Python.

It accepts any input, and is small on a Cortex-M4F.
"""

import c_programs as c
from c_programs import ANCHORS, GCC, by_numpy, cases, chosen, on_board, on_host, write
from documented import blocks, section
import numpy as np
from programs import run
import pytest

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.exporting.c_code import vehicle_code, write_c
from uwb_tdoa_tools.exporting.onnx_file import write_onnx
from uwb_tdoa_tools.exporting.tracing import trace

pytestmark = pytest.mark.skipif(GCC is None, reason="no C compiler (gcc)")
needs_board = pytest.mark.skipif(
    None in (c.ARM_GCC, c.QEMU), reason="no arm-none-eabi-gcc or no qemu-system-arm"
)
SANITIZED = (*c.STRICT, "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
KINDS = tuple(c.effects())
NO_PAIR, NOT_FINITE = 1, 2  # results of the functions in C


def same_bits(results, code, some):
    """Check bias and standard deviation bit by bit against numpy in single precision."""
    np.testing.assert_array_equal(results["wrong"], 0)
    for name, expected in zip(("bias", "std"), by_numpy(code, some)):
        np.testing.assert_array_equal(results[name], expected)
        np.testing.assert_array_equal(np.signbit(results[name]), np.signbit(expected))  # of 0


def agree(folder, effect_set, network=None):
    """Check the C code of a correction against numpy and Python, on this computer."""
    code, some = vehicle_code(ANCHORS, effect_set, network), cases(10_000)
    write(folder, code)
    results = on_host(folder, some)
    same_bits(results, code, some)
    samples = c.samples_of(some)
    expected = Corrector(ANCHORS, effect_set, network).prediction(samples)
    np.testing.assert_allclose(results["bias"], expected.bias, atol=1e-5)
    np.testing.assert_allclose(results["std"], expected.std, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*KINDS, "all"])
def test_every_effect_is_equal_to_numpy_and_python(tmp_path, name):
    agree(tmp_path, chosen(*(KINDS if name == "all" else (name,))))


def test_near_the_floor_low_anchors_are_noise(tmp_path):
    """C holds the weight of floor_multipath for a filter that has none of its own."""
    floor = EFFECTS["floor_multipath"]({"0.delay": 3.0, "0.height": 0.1, "x": 0.0, "y": 0.0})
    traced = trace(ANCHORS, EffectSet((EFFECTS["anchor_delay"]({"1": 0.2}), floor)))
    write_c(tmp_path, traced)
    agree(tmp_path / "again", EffectSet((*traced.effects, *traced.floor)))
    some = cases(4)
    some["a"], some["b"] = [0, 0, 0, 1], [1, 1, 1, 2]
    some["state"]["position"] = [[0, 0, 0.02], [2, 2, 0.3], [0, 0, 0.6], [0, 0, 0.02]]
    results = on_host(tmp_path, some)
    np.testing.assert_allclose(results["bias"], [0.2, 0.2, 0.2, -0.2], atol=1e-6)
    np.testing.assert_allclose(results["std"], [3.0, 3.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("orientations", [True, False])
def test_both_networks_are_equal_to_numpy_and_python(tmp_path, orientations):
    held = chosen("anchor_delay", "tag_lever_arm")
    agree(tmp_path, held, c.network(tmp_path, orientations))


@pytest.mark.slow
def test_c_onnx_and_python_state_the_same_bias_and_standard_deviation(tmp_path):
    held, network, some = chosen(*KINDS), c.network(tmp_path), cases(10_000)
    write(tmp_path, vehicle_code(ANCHORS, held, network))
    write_onnx(tmp_path / "bias.onnx", ANCHORS, held, network)
    in_c, samples = on_host(tmp_path, some), c.samples_of(some)
    in_onnx, in_python = (
        Corrector(ANCHORS, *given).prediction(samples)
        for given in ((None, load_network(tmp_path / "bias.onnx")), (held, network))
    )
    for name in ("bias", "std"):
        expected = getattr(in_python, name)
        np.testing.assert_allclose(in_c[name], expected, atol=1e-4)
        np.testing.assert_allclose(getattr(in_onnx, name), expected, atol=1e-4)
        assert np.ptp(expected) > 0.1


@pytest.mark.parametrize("name", ["antenna_pattern", "received_power_bias"])
def test_an_angle_of_a_pattern_is_wrapped_by_a_comparison(name):
    """floorf of the C library takes a hundred instructions for each anchor."""
    source = vehicle_code(ANCHORS, chosen(name)).files["uwb_bias.c"]
    assert "atan2f(" in source and "floorf(" not in source


def numbers_of(some):
    """Return the numbers of the states of cases, (n, 19), as a view."""
    return some.view(np.float32).reshape(len(some), -1)[:, 2:]


def odd_cases(n):
    """Return cases. Most contain numbers or ids that do not occur in practice."""
    some, rng = cases(n, seed=5), np.random.default_rng(5)
    odd = np.float32(
        [np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, 0.0, -0.0, 1e20, -1e20, 2.0**31, 1e-20]
    )
    numbers = numbers_of(some)
    hit = rng.random(numbers.shape) < rng.choice([0.0, 0.03, 0.3, 1.0], (n, 1))
    numbers[hit] = rng.choice(odd, hit.sum())
    ids = np.array([-1, 6, 8, 256, 301, 65535, 65536, 2**31 - 1, -(2**31)], dtype=np.int32)
    for end in "ab":
        hit = rng.random(n) < 0.2
        some[end][hit] = rng.choice([*ids, *ANCHORS.ids], hit.sum())
    return some


@pytest.mark.slow
@pytest.mark.parametrize("with_network", [False, True])
def test_no_input_is_a_fault(tmp_path, with_network):
    network = c.network(tmp_path) if with_network else None
    code, some = vehicle_code(ANCHORS, chosen(*KINDS), network), odd_cases(20_000)
    write(tmp_path, code)
    results = on_host(tmp_path, some, SANITIZED)
    bad_pair = (ANCHORS.index(some["a"]) < 0) | (ANCHORS.index(some["b"]) < 0)
    bad_pair |= some["a"] == some["b"]
    numbers = numbers_of(some)
    wrong = results["wrong"]
    np.testing.assert_array_equal(wrong == NO_PAIR, bad_pair)
    assert (wrong[~bad_pair & ~np.isfinite(numbers).all(axis=1)] == NOT_FINITE).all()
    for name in ("bias", "std"):
        assert np.isfinite(results[name]).all() and not results[name][wrong != 0].any()
    assert (wrong == 0).any() and results["bias"].any()


def calls_libm(name):
    """Return whether the C code of an effect calls a function that differs between C libraries."""
    return any(one.kind in c.LIBM for one in vehicle_code(ANCHORS, chosen(name)).program.scalars)


@pytest.mark.slow
@needs_board
def test_the_board_computes_the_same_bits(tmp_path):
    """+, -, *, / and the square root follow IEEE 754, so effects without libm agree."""
    names = [name for name in KINDS if not calls_libm(name)]
    assert {"tag_lever_arm", "nlos", "spline over speed"} <= set(names)
    code, some = vehicle_code(ANCHORS, chosen(*names)), cases(1000)
    write(tmp_path, code)
    results, _ = on_board(tmp_path, some, (*c.FIRMWARE, "-ffp-contract=off"))
    same_bits(results, code, some)


@pytest.mark.slow
@needs_board
def test_the_board_agrees_with_the_flags_of_the_firmware(tmp_path):
    network, some = c.network(tmp_path), cases(1000)
    write(tmp_path, vehicle_code(ANCHORS, chosen(*KINDS), network))
    here, (there, _) = on_host(tmp_path, some), on_board(tmp_path, some)
    np.testing.assert_array_equal(there["wrong"], 0)
    np.testing.assert_allclose(there["bias"], here["bias"], atol=1e-5)
    np.testing.assert_allclose(there["std"], here["std"], atol=1e-5)
    odd, _ = on_board(tmp_path, odd_cases(1000))
    assert np.isfinite(odd["bias"]).all() and set(odd["wrong"]) == {0, NO_PAIR, NOT_FINITE}


@pytest.mark.slow
@needs_board
def test_it_fits_a_small_vehicle(tmp_path):
    ten = c.cost_of(tmp_path / "ten", vehicle_code(ANCHORS, chosen(*c.COMMON)))
    assert ten["most"] <= 4000 and ten["own"] <= 4096 and ten["ram"] <= 2048
    network = c.network(tmp_path)
    learned = c.cost_of(tmp_path / "network", vehicle_code(ANCHORS, EffectSet(), network))
    assert learned["most"] <= 15_000 and learned["flash"] <= 13 * 1024
    assert learned["ram"] <= 2048


def test_the_example_of_the_page_compiles(tmp_path):
    (code,) = blocks(section("export.md", "C99, and a Crazyflie"), "c")
    write(tmp_path, vehicle_code(ANCHORS, chosen("anchor_delay")))
    (tmp_path / "example.c").write_text(f"{code}\nint main(void) {{ return 0; }}\n")
    files = [tmp_path / "example.c", tmp_path / "uwb_bias.c"]
    done = run(GCC, *c.STRICT, "-I", tmp_path, *files, "-lm", "-o", tmp_path / "example")
    assert done.returncode == 0, done.stderr
