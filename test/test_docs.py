"""The documents are correct: links and file names exist, examples run, and laws, commands and exports are complete."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
import textwrap
from pathlib import Path

import click
import pytest
import yaml

import plow_twin
from plow_twin.cli.app import commands
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.mapping import read_map
from plow_twin.scene_file import loads_scene
from plow_twin.study.calibration.unknowns import parse_unknown
from plow_twin.telemetry.access import Credentials

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text()
    assert not re.search(r"PLACEHOLDER|TODO|TBD", text)
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert "://" in target or (page.parent / target).exists(), target
    for name in re.findall(r"`((?:plow_twin|config|test|docs|tools|benchmark|launch|examples)/[\w/.]+)`", text):
        assert (ROOT / name).exists(), name
    subpackages = "|".join(path.parent.name for path in (ROOT / "plow_twin").glob("*/__init__.py"))
    for name in re.findall(rf"`((?:{subpackages})/[\w/]+\.py)`", text):
        assert (ROOT / "plow_twin" / name).exists(), name


def shown_calls() -> list[tuple[str, str]]:
    """Return each call of `plow-twin` in a code block, and the name of its page."""
    pages = [*PAGES, *sorted((ROOT / "examples").rglob("*.md"))]
    return [
        (page.name, call.partition("#")[0])
        for page in pages
        for block in re.findall(r"^ *```\w*\n(.*?)^ *```", page.read_text(), re.DOTALL | re.MULTILINE)
        for call in re.findall(r"plow-twin (.*)", block.replace("\\\n", " "))
    ]


def test_every_command_on_a_page_has_an_existing_verb_and_valid_options() -> None:
    calls = shown_calls()
    assert len(calls) > 40
    unknown = []
    for page, call in calls:
        command, words = commands, re.split(r"\s+", re.split(r"[|&<>]", call)[0].strip())
        words = words[2:] if words[0] == "--laws" else words  # all verbs accept the option `--laws`
        while isinstance(command, click.Group) and words and words[0] in command.commands:
            command = command.commands[words.pop(0)]
        valid = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)} | {
            "--help"
        }
        options_given = {word for word in words if word.startswith("--") and not word.startswith("---")}
        required = [{*one.opts} for one in command.params if isinstance(one, click.Option) and one.required]
        incomplete = options_given != {"--help"} and not all(options & options_given for options in required)
        if (isinstance(command, click.Group) and options_given != {"--help"}) or options_given - valid or incomplete:
            unknown.append((page, call))
    assert unknown == []


def test_the_mappings_and_credentials_of_the_how_to_are_read(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "how_to_connect.md").read_text()
    shown = re.findall(r"^ *```yaml\n(.*?)^ *```", page, re.DOTALL | re.MULTILINE)
    assert len(shown) == 2
    for block in shown:
        (tmp_path / "map.yaml").write_text(textwrap.dedent(block))
        assert read_map(tmp_path / "map.yaml", None).keys() == {"excitation", "travel"}
    for section, names in (("mqtt", ["mqtt.secret", "broker.pem"]), ("influx", ["influx.token"])):
        line = next(text for text in re.findall(r"`(\w+: \{.*?\})`", page) if text.startswith(section))
        (tmp_path / "access.yaml").write_text(line)
        for name in names:
            (tmp_path / name).write_text("x")
        read = Credentials.read(tmp_path / "access.yaml")
        files = [read.file(section, key) for key in read.sections[section] if key != "user"]
        assert {Path(str(file)).name for file in files} == {*names}


def public_names() -> set[str]:
    """Return the names that `plow_twin/__init__.py` exports by `import x as x`, directly or lazily."""
    nodes = ast.walk(ast.parse((ROOT / "plow_twin" / "__init__.py").read_text()))
    aliases = [alias for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names]
    return {alias.name for alias in aliases if alias.asname == alias.name}


def test_the_reference_page_lists_exactly_the_public_names() -> None:
    listed = re.findall(r"^::: plow_twin\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert len(listed) == len({*listed}) > 30
    assert {*listed} == public_names()
    assert all(hasattr(plow_twin, name) for name in listed)


def test_no_heading_begins_with_a_digit() -> None:
    """The table of contents selects headings by CSS selectors, which must not begin with a digit."""
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("**/README.md")]
    headings = [line for page in pages for line in re.findall(r"^#+ \d.*", page.read_text(), re.MULTILINE)]
    assert headings == []


def test_every_row_of_a_table_is_a_single_line() -> None:
    pages = [*PAGES, *(ROOT / "examples").glob("**/README.md")]
    assert [line for page in pages for line in re.findall(r"^\|.*[^|\n]$", page.read_text(), re.MULTILINE)] == []


def test_every_page_is_in_the_site_s_contents() -> None:
    contents = (ROOT / "mkdocs.yml").read_text().partition("nav:")[2]
    made = {"index.md", "examples.md"}
    assert {*re.findall(r": (\w+\.md)$", contents, re.MULTILINE)} == made | {
        page.name for page in (ROOT / "docs").glob("*.md")
    }


def test_every_table_of_the_pages_agrees_with_results_and_code() -> None:
    """The tables of the pages are up to date, and each table of `tools/pages.py` is on a page."""
    code = (
        "import pages, re\n"
        "texts = {page.name: page.read_text() for page in pages.PAGES}\n"
        "print([name for name, text in texts.items() if pages.renewed(text) != text])\n"
        "named = re.findall('<!-- made: (.*) -->', '\\n'.join(texts.values()))\n"
        "print(set(named) ^ pages.TABLES.keys(), 'made: speed' in texts['README.md'])\n"
    )
    completed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT / "tools", capture_output=True, text=True, timeout=280, check=False
    )
    assert completed.stdout.splitlines() == ["[]", "set() True"], completed.stderr or completed.stdout


def test_drawn_pictures_agree_with_their_scripts() -> None:
    pictures = [runpy.run_path(str(ROOT / "tools" / name)) for name in ("lanes_picture.py", "architecture.py")]
    assert all(made["OUT"].read_text() == made["drawing"]() for made in pictures)
    made = pictures[-1]
    subpackages = {name for row in made["SUBPACKAGES"] for name, _ in row}
    folders = {path.parent.name for path in (ROOT / "plow_twin").glob("*/__init__.py")}
    assert folders <= subpackages


def test_the_tutorial_and_the_example_have_the_same_scene() -> None:
    (scene,) = blocks(ROOT / "docs" / "tutorial.md", "yaml")
    assert scene == (ROOT / "examples" / "first_scene" / "scene.yaml").read_text()


def test_the_unknowns_of_the_how_to_are_numbers_of_the_tutorial_s_scene_within_their_ranges() -> None:
    (text,) = blocks(ROOT / "docs" / "tutorial.md", "yaml")
    scene = loads_scene(text)
    (call,) = (call for _, call in shown_calls() if call.startswith("study calibrate mine.yaml"))
    by_path = {path: parse_unknown(unknown, scene) for unknown, path in re.findall(r"--unknown (([^\s=]+)\S*)", call)}
    stiffness, damping = (by_path[f"contact.{name}"] for name in ("stiffness", "damping"))
    assert scene.contact.damping is not None
    assert stiffness.low < scene.contact.stiffness < stiffness.high
    assert damping.low < scene.contact.damping < damping.high


def test_every_test_named_beside_a_promise_exists() -> None:
    text = (ROOT / "docs" / "operators.md").read_text()
    named = re.findall(r"`(test_\w+\.py)::(\w+)`", text)
    assert len(named) > 60
    sources = {file: (ROOT / "test" / file).read_text() for file, _ in named}
    assert [(file, test) for file, test in named if f"def {test}(" not in sources[file]] == []
    promises, _, notes = text.partition("## Tests of the promises")
    referred = re.findall(r"^- [^[]+\[\^(\d+)\]$", promises, re.MULTILINE)
    assert len(referred) == len(re.findall("^- ", promises, re.MULTILINE))
    tests = dict(re.findall(r"^\[\^(\d+)\]: (.*)$", notes, re.MULTILINE))
    assert sorted(referred) == sorted(tests)
    assert all("::test_" in named or "benchmark/" in named for named in tests.values())


@pytest.mark.parametrize("page", ["README.md", "docs/interface.md"])
def test_the_page_s_example_runs(page: str) -> None:
    (example,) = blocks(ROOT / page, "python")
    code = f"{example}\nprint(result.solver)"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=280, check=False)
    assert completed.returncode == 0, completed.stderr
    assert "'method': 'events'" in completed.stdout


def test_the_law_of_the_how_to_runs() -> None:
    (example,) = blocks(ROOT / "docs" / "how_to_own_law.md", "python")
    # a separate process, because an added law cannot be removed
    code = f"{example}\nfrom plow_twin.model.contact_laws import LAWS\nprint(LAWS[contact.law].damping_number(0.4))"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=280, check=False)
    assert (completed.stdout.strip(), completed.stderr) == (str(1.2 * (1.0 - 0.4) / 0.4), "")


def test_the_interface_page_agrees_with_the_code() -> None:
    page = (ROOT / "docs" / "interface.md").read_text()
    (scene,) = blocks(ROOT / "docs" / "interface.md", "yaml")
    assert yaml.safe_load(scene)["version"] == 1
    assert loads_scene(scene, ROOT).wear is not None and loads_scene(scene, ROOT).friction is not None
    for name in (*PAIR_NAMES, *LAWS):
        assert f"`{name}`" in page, name
    for verb in commands.commands:
        assert f"`{verb} " in page or f"`{verb}`" in page, verb
    for name in re.findall(r"`(Scene|Head|Frame|Clearance|\w+Error|Twin|Result)`", page):
        assert hasattr(plow_twin, name), name


def test_the_model_page_names_reconstruction_s_figures() -> None:
    text = (ROOT / "docs" / "model.md").read_text()
    result = plow_twin.simulate(loads_scene((ROOT / "config" / "paper.yaml").read_text(), ROOT), 60.0)
    table = result.statistics
    for pair, senses in (("bottom_right_bottom", "147.6 / 75.0 kN"), ("top_right_top", "183.3 / 90.2 kN")):
        row = table[pair]
        assert f"{row['max'] / 1e3:.1f} / {row['mean_in_contact'] / 1e3:.1f} kN" == senses
        assert senses in text
