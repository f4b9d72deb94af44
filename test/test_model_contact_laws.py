"""Contact laws: closed forms, the exact restitution, and the series compared with the formula."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import plow_twin
from hypothesis import given
from hypothesis import strategies as st

from plow_twin import ArgumentError, Clearance, Contact, Frame, Head, Scene, SceneError
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row
from plow_twin.model import contact
from plow_twin.model.contact import power_term, power_terms, root_terms
from plow_twin.model.contact_laws import DAMPING_NUMBER_CAP, LAWS, ContactLaw, add_law, exact_damping_number
from plow_twin.scene_file.presets import config_folder


@kernel(entry=True)
def normal_force(*numbers: float) -> float:
    return contact.normal_force(*numbers)


@kernel(entry=True)
def free_force(*numbers: float) -> float:
    return contact.free_force(*numbers)


@pytest.mark.parametrize(
    ("e", "d"), [(0.1, 9.998159), (0.3, 3.087082), (0.5, 1.432751), (0.7, 0.634828), (0.9, 0.166482)]
)
def test_exact_damping_factor_equals_the_published_factor(e: float, d: float) -> None:
    assert exact_damping_number(e) == pytest.approx(d, abs=5e-7)


@given(st.floats(0.02, 0.999))
def test_exact_damping_factor_satisfies_its_identity(e: float) -> None:
    d = exact_damping_number(e)
    assert 0.0 < d <= 1.0 / e
    if 1.0 - d * e > 1e-9:
        assert d * (1.0 + e) == pytest.approx(math.log((1.0 + d) / (1.0 - d * e)), rel=1e-6)


def test_nearly_elastic_damping_is_its_series() -> None:
    """D = 3/2 x (1 + x + ..) with x = 1 - e, for which rounding errors dominate the residual of the identity."""
    for x in 10.0 ** np.linspace(-15.0, -4.0, 45):
        e = 1.0 - x
        assert exact_damping_number(e) == pytest.approx(1.5 * (1.0 - e) * (2.0 - e), rel=1e-6)


def test_limits_of_restitution_stay_finite() -> None:
    for name, law in LAWS.items():
        if law.takes_restitution:
            assert law.damping_number(1.0) == 0.0, name
            assert 0.0 < law.damping_number(0.0) <= DAMPING_NUMBER_CAP, name


@given(st.floats(-0.01, 0.02), st.floats(-5.0, 5.0), st.floats(0.0, 20.0), st.sampled_from([1.0, 1.5, 2.0, 2.2]))
def test_contact_never_pulls_and_acts_only_inside(d: float, rate: float, factor: float, n: float) -> None:
    force = normal_force(d, rate, 1e7, n, factor, 0.0, 0.0)
    assert force >= 0.0
    assert d > 0.0 or force == 0.0
    if d > 0.0 and 1.0 + factor * rate > 0.0:
        assert force == pytest.approx(1e7 * d**n * (1.0 + factor * rate))
    if d > 0.0:
        assert force == max(0.0, free_force(d, rate, 1e7, n, factor, 0.0, 0.0))


def test_ramped_damping_grows_smoothly_to_its_value() -> None:
    damping, ramp, rate = 5e4, 1e-3, 0.3
    for share, part in ((0.0, 0.0), (0.25, 0.15625), (0.5, 0.5), (1.0, 1.0), (3.0, 1.0)):
        d = share * ramp
        assert free_force(d, rate, 1e7, 1.0, 0.0, damping, ramp) == pytest.approx(1e7 * d + part * damping * rate)


@pytest.mark.parametrize(("shift", "n"), [(0, 1.5), (0, 2.2), (2, 1.5)])
def test_power_series_equals_the_power(shift: int, n: float) -> None:
    order, t = 24, 0.11
    base, power = np.zeros((order + 1, 8)), np.zeros((order + 1, 8))
    base[shift : shift + 4, 3] = [0.7, -0.4, 0.3, 0.2]
    for k in range(order + 1):
        power[k, 3] = power_term(base, power, 3, k, n, shift)
    value = np.polynomial.polynomial.polyval(t, base[:, 3]) ** n
    assert np.polynomial.polynomial.polyval(t, power[:, 3]) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("n", [0.5, 1.5, 2.2])
def test_eight_power_series_side_by_side_are_accurate(n: float) -> None:
    order, rng = 24, np.random.default_rng(5)
    base, power = np.zeros((order + 1, 8)), np.zeros((order + 1, 8))
    base[0], base[1:5] = rng.uniform(0.5, 2.0, 8), rng.uniform(-0.3, 0.3, (4, 8))
    _raise(base, power, n, 1.0 / base[0], 0.5 / np.sqrt(base[0]))
    t = 0.2
    value = np.polynomial.polynomial.polyval(t, base) ** n
    assert np.polynomial.polynomial.polyval(t, power) == pytest.approx(value, rel=1e-12)


@kernel(entry=True)
def _raise(base, power, n, inverse, half_root) -> None:  # type: ignore[no-untyped-def]
    for lane in range(8):
        power[0, lane] = base[0, lane] ** n
    for k in range(1, base.shape[0]):
        if n == 0.5:
            set_row(power, k, root_terms(row(base, k), power, k) * row(half_root, 0))
        else:
            set_row(power, k, power_terms(base, power, k, n) * row(inverse, 0))


@pytest.mark.parametrize(
    ("contact", "words"),
    [
        ({"law": "kelvin_voigt", "stiffness": 1e7, "restitution": 0.5}, "contact.restitution"),
        ({"law": "hertz", "stiffness": 1e7, "damping": 1.0}, "no damping at all for hertz"),
        ({"law": "hunt_crossley", "stiffness": 1e7}, "damping or restitution for hunt_crossley"),
        ({"law": "hunt_crossley", "stiffness": 1e7, "damping": 1.0, "restitution": 0.5}, "not both"),
        ({"law": "kelvin_voigt", "stiffness": 1e7, "exponent": 1.5, "damping": 1.0}, "contact.exponent: got 1.5"),
        ({"law": "spring", "stiffness": math.nan}, "contact.stiffness: got nan"),
    ],
)
def test_an_impossible_law_is_refused_by_name(contact: dict[str, object], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        Scene(Head(1.0, 1.0), Frame(0.1, 0.1), Clearance(0.01, 0.01), Contact(**contact))  # type: ignore[arg-type]


LAW = ContactLaw("x", "x")


@pytest.mark.parametrize(("name", "law"), [("2nd", LAW), ("ré", LAW), ("class", LAW), ("x", abs)])
def test_a_law_without_a_valid_name_or_type_is_refused(name: str, law: Any) -> None:
    with pytest.raises(ArgumentError, match="contact law"):
        add_law(name, law)


@pytest.mark.parametrize("number_of", [lambda e: None, lambda e: [][1], lambda e: "1", lambda e: -1.0])
def test_a_law_without_a_damping_number_is_named(number_of: Callable[[float], Any]) -> None:
    with pytest.raises(ArgumentError, match=r"my law: D\(0\.5\): got .*expected a number >= 0"):
        ContactLaw("my law", "mine", number_of).damping_number(0.5)


def test_parts_of_the_wrong_kind_are_all_named_at_once() -> None:
    with pytest.raises(SceneError) as caught:
        Scene(None, Frame(0.1, 0.1), 3, Contact("hertz", 1e7), loads=None, pairs="all", wear=2.0)  # type: ignore[arg-type]
    keys = {problem.key for problem in caught.value.problems}
    assert keys == {"head", "clearance", "loads", "pairs", "wear"}
    labels = {"a": "top_left", "b": "top_left"}
    with pytest.raises(SceneError, match=r"frame\.labels.*each corner once"):
        Scene(Head(1.0, 1.0), Frame(0.1, 0.1, labels), Clearance(0.01, 0.01), Contact("hertz", 1e7))


def test_the_command_line_adds_laws_from_a_file(tmp_path: Path) -> None:
    scene, laws = tmp_path / "scene.yaml", tmp_path / "laws.py"
    scene.write_text((config_folder() / "paper.yaml").read_text().replace("law: hunt_crossley", "law: of_a_file"))
    laws.write_text(
        "import plow_twin\n"
        "plow_twin.add_law('of_a_file', plow_twin.ContactLaw('own', 'D = 1 - e; made up', lambda e: 1.0 - e))\n"
    )
    empty = tmp_path / "empty.py"
    empty.write_text("")
    refused = plow_twin("info", scene)
    assert refused.returncode == 2 and "contact.law: got 'of_a_file'" in refused.stderr
    assert plow_twin("--laws", laws, "info", scene).returncode == 0
    for wrong, message in ((empty, "calls plow_twin.add_law"), (tmp_path / "none.py", "No such file")):
        completed = plow_twin("--laws", wrong, "info", scene)
        assert completed.returncode == 2 and message in completed.stderr and "Traceback" not in completed.stderr
