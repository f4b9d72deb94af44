"""Scene files: reading, error messages, and writing and reading back without loss."""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from plow_twin import (
    PAIR_NAMES,
    Clearance,
    Constant,
    Contact,
    Frame,
    Gravity,
    Harmonic,
    Head,
    Initial,
    Mark,
    Provenance,
    Scene,
    SceneError,
    Table,
    Wear,
)
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.pairs import CORNER_NAMES
from plow_twin.model.scene import DOF_NAMES, LEAST_SPACING_S
from plow_twin.scene_file import dump_scene, load_scene, loads_scene, scene_schema
from plow_twin.scene_file.presets import PRESETS, scene_path

MINIMAL = """
version: 1
head: {mass_kg: 2430, inertia_kg_m2: 1265}
frame: {width_m: 0.33, height_m: 0.27}
clearance: {horizontal_m: 0.025, vertical_m: 0.030}
contact: {law: hunt_crossley, stiffness: 9.6975e6, damping: 0.72154}
"""


def test_numbers_are_read_in_common_notations() -> None:
    scene = loads_scene(MINIMAL)
    assert scene.contact.stiffness == 9.6975e6  # YAML 1.1 reads a number in this notation as a text
    assert type(scene.head.mass_kg) is float
    assert scene.pairs == PAIR_NAMES
    assert scene.wear is None
    assert scene.loads == ()


@pytest.mark.parametrize("name", PRESETS)
def test_presets_state_where_each_number_comes_from(name: str) -> None:
    scene = load_scene(scene_path(name))
    unmarked = [
        f"{part}.{spec.name}"
        for part in ("head", "frame", "clearance", "gravity", "initial")
        for spec in fields(getattr(scene, part))
        if "unit" in spec.metadata
        and spec.name != "com_offset_m"
        and f"{part}.{spec.name}" not in scene.marks
        and getattr(getattr(scene, part), spec.name) is not None
    ]
    assert not unmarked
    damping = "contact.damping" if scene.contact.restitution is None else "contact.restitution"
    assert {"contact.stiffness", "contact.exponent", damping} <= scene.marks.keys()
    for index, load in enumerate(scene.loads):
        for key in ("force_n", "omega_rad_s", "phase_rad", "moment_n_m", "at_m"):
            path = f"loads[{index}].{key}"
            assert path in scene.marks or f"{path}[0]" in scene.marks, f"{load.name}: {path}"
    assert all(mark.source for mark in scene.marks.values())


def test_a_number_can_state_its_standard_deviation() -> None:
    marked = "{horizontal_m: {value: 0.025, mark: assumed, deviation: 0.002}, vertical_m: {value: 0.03, mark: given}}"
    scene = loads_scene(MINIMAL.replace("{horizontal_m: 0.025, vertical_m: 0.030}", marked))
    assert scene.marks["clearance.horizontal_m"] == Provenance(Mark.ASSUMED, "", 0.002)
    assert scene.marks["clearance.vertical_m"].deviation is None
    assert loads_scene(dump_scene(scene)).marks == scene.marks
    for wrong in ("-0.002", "wide", ".inf"):
        with pytest.raises(SceneError, match=r"clearance\.horizontal_m\.deviation: .*standard deviation"):
            loads_scene(MINIMAL.replace("{horizontal_m: 0.025, vertical_m: 0.030}", marked.replace("0.002", wrong)))


def test_paper_preset_is_reconstruction_r1() -> None:
    scene = load_scene(scene_path("paper"))
    force = np.array([load.force_n for load in scene.loads])
    arm = np.array([load.at_m for load in scene.loads])
    moment = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
    np.testing.assert_array_equal(force.sum(axis=0), [32e3, -11e3])
    np.testing.assert_allclose(moment, [-66.24e3, 14.94e3, -0.96e3, 6.765e3], rtol=1e-15)
    assert (scene.contact.law, scene.contact.stiffness, scene.contact.damping) == ("hunt_crossley", 9.6975e6, 0.72154)
    assert scene.contact.exponent == 1.0
    assert scene.marks["head.mass_kg"].mark is Mark.GIVEN
    assert scene.marks["contact.stiffness"].mark is Mark.RECONSTRUCTED
    assert scene.marks["loads[0].force_n[0]"].mark is Mark.RECONSTRUCTED
    assert "fitted to the paper's published figures" in scene_path("paper").read_text().lower()


def test_one_error_lists_every_problem(tmp_path: Path) -> None:
    text = """
version: 2
head: {mass_kg: -1, inertia_kg_m2: heavy, mas: 3, rotation: papr}
frame: {width_m: {value: 0, mark: guessed}, labels: {a: up, 1: top_left}}
contact: {law: kelvin_voigt, stiffness: 1e7, damping: 6e4, restitution: 0.3, exponent: 2}
gravity: {arm_m: .nan}
gravity: {arm_m: .inf}
loads:
  - {name: a, harmonic: {force_n: [1, x]}, at_m: {value: [1, true], mark: given}}
  - {name: b, constant: {}, harmonics: 3}
  - {harmonic: {}, constant: {}}
  - {name: c, table: {file: no.csv}}
  - {name: d, table: {t: [0, 1], wrench: [[1, 2, 3], [1, 2]]}}
  - 3
pairs: [top, top_left_top]
locked: z
wear: {coefficient_m2_n: 1e-14}
initial: 4
gravty: 3
"""
    with pytest.raises(SceneError) as caught:
        loads_scene(text, tmp_path, source="bad.yaml")
    got = {problem.key: (repr(problem.got), problem.expected) for problem in caught.value.problems}
    expected = {
        "version": "2",
        "gravity": "'the key twice, in lines 6 and 7'",
        "head.mass_kg": "-1",
        "head.inertia_kg_m2": "'heavy'",
        "head.mas": "3",
        "head.rotation": "'papr'",
        "frame.width_m.value": "0",
        "frame.width_m.mark": "'guessed'",
        "frame.labels.a": "'up'",
        "frame.labels": "1",
        "frame.height_m": "nothing",
        "clearance": "nothing",
        "contact": "{'damping': 60000.0, 'restitution': 0.3}",
        "contact.restitution": "0.3",
        "contact.exponent": "2.0",
        "gravity.arm_m": "inf",
        "loads[0].harmonic.force_n[1]": "'x'",
        "loads[0].at_m.value[1]": "True",
        "loads[1].harmonics": "3",
        "loads[2].name": "nothing",
        "loads[2]": "['constant', 'harmonic']",
        "loads[3].table.file": repr(str(tmp_path / "no.csv")),
        "loads[4].table.wrench[1]": "[1, 2]",
        "loads[5]": "3",
        "pairs[0]": "'top'",
        "locked": "'z'",
        "wear.pad_area_m2": "nothing",
        "wear.travel_speed_m_s": "nothing",
        "initial": "4",
        "gravty": "3",
    }
    missing = {key: value for key, value in expected.items() if got.get(key, ("", ""))[0] != value}
    assert not missing, f"not reported: {missing}\n{caught.value}"
    assert got.keys() - {"frame.labels.1"} == expected.keys()
    assert "mass_kg" in got["head.mas"][1]  # the error names the most similar known key
    assert got["gravty"][1] == "a known key; did you mean gravity?"
    assert got["head.mass_kg"][1] == "a finite number > 0 [kg]"
    assert str(caught.value).startswith("bad.yaml: ")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1, 2]",
        "a: [",
        "&a [*a]",
        "x: &a {b: *a}",
        "\x00",
        "a: !!python/name:os.system {}",
        "version: 1" + "0" * 5000,
    ],
)
def test_an_invalid_text_raises_a_scene_error(text: str) -> None:
    with pytest.raises(SceneError):
        loads_scene(text)


def test_a_scene_has_the_exact_restitution_by_default() -> None:
    text = """
version: 1
head: {mass_kg: 10, inertia_kg_m2: 1}
frame: {width_m: 0.3, height_m: 0.3}
clearance: {horizontal_m: 0.01, vertical_m: 0.01}
"""
    scene = loads_scene(text + "contact: {stiffness: 1.0e8, restitution: 0.4}", Path())
    assert scene.contact == Contact(stiffness=1e8, restitution=0.4)
    assert scene.contact == Contact("exact_restitution", 1e8, restitution=0.4)
    with pytest.raises(SceneError, match=r"contact\.stiffness: got nothing"):
        loads_scene(text + "contact: {restitution: 0.4}", Path())
    with pytest.raises(SceneError, match=r"contact\.stiffness: got nan"):
        replace(scene, contact=Contact(restitution=0.4))


def test_texts_are_no_numbers() -> None:
    with pytest.raises(SceneError, match=r"head.mass_kg: got '2430'"):
        loads_scene(MINIMAL.replace("2430", "'2430'"))


def test_the_dump_contains_the_table_from_a_file(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 11)
    wrench = np.random.default_rng(3).normal(size=(11, 3))
    rows = "\n".join(
        f"{m!r},{fx!r},{time!r},{fy!r}" for time, (fx, fy, m) in zip(t.tolist(), wrench.tolist(), strict=True)
    )
    (tmp_path / "load.csv").write_text(f"# measured\nmoment,fx,time,fy\n{rows}\n")
    load = "loads: [{name: cut, table: {file: load.csv, columns: [time, fx, fy, moment], hold: zero}}]"
    (tmp_path / "scene.yaml").write_text(MINIMAL + load)
    scene = load_scene(tmp_path / "scene.yaml")
    again = loads_scene(dump_scene(scene), base="/nonexistent")
    for read in (scene, again):
        (table,) = read.loads
        assert isinstance(table, Table)
        np.testing.assert_array_equal(table.t, t)
        np.testing.assert_array_equal(table.wrench, wrench)
        assert table.hold == "zero"


def test_a_table_is_read_as_any_other_csv_file(tmp_path: Path) -> None:
    """A byte order mark is not part of the name `t`, and semicolons separate columns."""
    scene = MINIMAL + "loads: [{name: cut, table: {file: load.csv}}]"
    for text in (
        "time;fx;fy;m\r\n0;1,5;2;3\r\n\r\n0,5;1;-2,25;3\r\n",
        "\ufefft\tfx\tfy\tm\n0\t1,5\t2\t3\n0,5\t1\t-2,25\t3\n",
    ):
        (tmp_path / "load.csv").write_text(text, encoding="utf-8", newline="")
        (table,) = loads_scene(scene, tmp_path).loads
        assert isinstance(table, Table)
        np.testing.assert_array_equal(table.t, [0.0, 0.5])
        np.testing.assert_array_equal(table.wrench, [[1.5, 2.0, 3.0], [1.0, -2.25, 3.0]])
    (tmp_path / "load.csv").write_text("t;fx;fy;fx;m\n")
    with pytest.raises(SceneError, match="expected a header line with t, fx, fy, m, each name once"):
        loads_scene(scene, tmp_path)


def test_bad_rows_of_a_table_are_named(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n0,1,2,3\n1,1,x,3\n2,1\n")
    with pytest.raises(SceneError) as caught:
        loads_scene(MINIMAL + "loads: [{name: cut, table: {file: load.csv}}]", tmp_path)
    assert [problem.key for problem in caught.value.problems] == [
        "loads[0].table.file line 3",
        "loads[0].table.file line 4",
    ]
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n0,1,2,3\n0,1,2,3\n")
    with pytest.raises(SceneError, match=r"loads\[0\]\.table\.t\[1\]: got 0.0, expected more than the time before it"):
        loads_scene(MINIMAL + "loads: [{name: cut, table: {file: load.csv}}]", tmp_path)


def test_schema_is_valid_and_covers_every_field() -> None:
    schema = scene_schema()
    Draft202012Validator.check_schema(schema)
    json.dumps(schema)
    wear = schema["properties"]["wear"]["anyOf"][0]
    assert wear["properties"].keys() == {spec.name for spec in fields(Wear)}
    assert set(wear["required"]) == {spec.name for spec in fields(Wear) if spec.default is MISSING}
    assert schema["properties"].keys() - {"version"} == {spec.name for spec in fields(Scene)} - {"marks"}


FINITE = st.floats(allow_nan=False, allow_infinity=False)
POSITIVE = st.floats(min_value=0.0, exclude_min=True, allow_infinity=False)
PAIR = st.tuples(FINITE, FINITE)
TRIPLE = st.tuples(FINITE, FINITE, FINITE)
NAME = st.text(min_size=1, max_size=12)


@st.composite
def contacts(draw: st.DrawFn) -> Contact:
    law = draw(st.sampled_from(sorted(LAWS)))
    exponent = draw(st.floats(1.0, 4.0)) if LAWS[law].exponent is None else LAWS[law].exponent
    assert exponent is not None
    choices: list[dict[str, Any]] = []
    if LAWS[law].takes_damping:
        choices.append({"damping": draw(st.floats(0.0, 1e6))})
    if LAWS[law].takes_restitution:
        choices.append({"restitution": draw(st.floats(0.0, 1.0))})
    damping = draw(st.sampled_from(choices)) if choices else {}
    ramp = draw(POSITIVE) if LAWS[law].ramped else None
    return Contact(law, draw(POSITIVE), exponent, **damping, impact_speed_floor_m_s=draw(POSITIVE), ramp_m=ramp)


@st.composite
def tables(draw: st.DrawFn, name: str) -> Table:
    t = np.array(sorted(draw(st.sets(FINITE, min_size=1, max_size=5))))
    t = t[np.diff(t, prepend=-np.inf) >= LEAST_SPACING_S]
    wrench = np.array([draw(TRIPLE) for _ in t])
    return Table(name, t, wrench, draw(st.sampled_from(["linear", "zero"])), draw(PAIR))


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    loads: list[Any] = []
    for name in draw(st.lists(NAME, max_size=3, unique=True)):
        kind = draw(st.sampled_from(["harmonic", "constant", "table"]))
        if kind == "harmonic":
            loads.append(Harmonic(name, draw(PAIR), draw(POSITIVE), draw(FINITE), draw(FINITE), draw(PAIR)))
        elif kind == "constant":
            loads.append(Constant(name, draw(PAIR), draw(FINITE), draw(PAIR)))
        else:
            loads.append(draw(tables(name)))
    contact = draw(contacts())
    ratio = draw(st.floats(1.0, 10.0))
    wear = Wear(
        draw(POSITIVE), draw(POSITIVE), draw(POSITIVE), (draw(POSITIVE),) * 8,
        sliding=draw(st.sampled_from(["travel", "total"])), running_in_ratio=ratio, running_in_depth_m=draw(POSITIVE),
    )  # fmt: skip
    rate = ratio * wear.coefficient_m2_n * wear.travel_speed_m_s / wear.pad_area_m2
    # a scene is rejected if a pad wears faster than its damper lets the head move
    bearable = not LAWS[contact.law].additive or not (contact.damping or 0.0) * rate > 1.0
    letters = draw(st.lists(NAME, max_size=len(CORNER_NAMES), unique=True))
    labels = dict(zip(letters, draw(st.permutations(CORNER_NAMES)), strict=False))
    locked = tuple(draw(st.lists(st.sampled_from(DOF_NAMES), unique=True)))
    x, y, theta = (0.0 if name in locked else draw(FINITE) for name in DOF_NAMES)
    scene = Scene(
        head=Head(draw(POSITIVE), draw(POSITIVE)),
        frame=Frame(draw(POSITIVE), draw(POSITIVE), labels),
        clearance=Clearance(draw(FINITE), draw(FINITE)),
        contact=contact,
        gravity=Gravity(draw(FINITE), draw(FINITE)),
        loads=tuple(loads),
        initial=Initial(draw(TRIPLE), (x, y, theta)),
        locked=locked,
        pairs=tuple(draw(st.lists(st.sampled_from(PAIR_NAMES), unique=True))),
        wear=draw(st.none() | st.just(wear)) if bearable else None,
    )
    places = ["head.mass_kg", "frame.width_m", "gravity.arm_m", "initial.q", "initial.q[2]", "initial.v[0]"]
    places += [f"loads[{index}].at_m" for index in range(len(loads))]
    provenance = st.builds(Provenance, st.sampled_from(Mark), st.text(max_size=20))
    return replace(scene, marks=draw(st.dictionaries(st.sampled_from(places), provenance)))


def _bits(value: Any) -> Any:
    """Return the value with floats as exact texts, so that -0.0 differs from 0.0."""
    if isinstance(value, float | np.floating):
        return float(value).hex()
    if isinstance(value, tuple | list | np.ndarray):
        return [_bits(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {spec.name: _bits(getattr(value, spec.name)) for spec in fields(value)}
    return {key: _bits(item) for key, item in value.items()} if hasattr(value, "items") else value


@given(scenes())
def test_a_dumped_scene_reads_back_the_same_bit_for_bit(scene: Scene) -> None:
    text = dump_scene(scene)
    assert _bits(loads_scene(text)) == _bits(scene)
    # other YAML readers get the same texts and sections
    assert yaml.safe_load(text)["head"]["rotation"] == "paper"


@given(st.sampled_from(["mass_kg", "inertia_kg_m2"]), FINITE | st.sampled_from([math.nan, math.inf]))
def test_a_number_out_of_range_is_always_refused(key: str, value: float) -> None:
    raw = yaml.safe_load(MINIMAL)
    raw["contact"]["stiffness"] = 1.0e7
    raw["head"][key] = value
    text = yaml.safe_dump(raw)
    if value > 0.0 and math.isfinite(value):
        assert getattr(loads_scene(text).head, key) == value
    else:
        with pytest.raises(SceneError, match=f"head.{key}"):
            loads_scene(text)
