"""Malicious files: lines that expand to millions of values, endless nesting, and names with terminal commands."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hostile_files import MADE
from hostile_files import run as recorded

from plow_twin.access import secret
from plow_twin.dashboard.access import PageAccess
from plow_twin.errors import ExcessError, InputError
from plow_twin.live.bridge.files import Files
from plow_twin.scene_file.validation import MOST_PROBLEMS
from plow_twin.scene_file.yaml_text import (
    DEEPEST,
    LARGEST_FILE,
    MOST_KEYS,
    MOST_REPEATED,
    MOST_VALUES,
    load_yaml,
    read_yaml,
)
from plow_twin.telemetry.access import Credentials

ROOT = Path(__file__).resolve().parent.parent


def nested(opening: str, levels: int) -> str:
    return opening * levels


def laughs(levels: int, times: int = 9) -> str:
    """Return nested lists of aliases that expand to `times` to the power of `levels` values."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * times)}]" for level in range(1, levels + 1)]
    return "\n".join(lines)


def merges(levels: int, times: int = 9) -> str:
    """Return mappings that merge other merging mappings, level by level."""
    lines = ["a0: &a0 {k: 1}"]
    lines += [
        f"a{level}: &a{level} {{<<: [{', '.join([f'*a{level - 1}'] * times)}]}}" for level in range(1, levels + 1)
    ]
    return "\n".join(lines)


def keys(count: int) -> str:
    return "\n".join(f"key{number:07d}: 1" for number in range(count))


FILES: dict[str, Callable[[], str]] = {
    "flow sequences": lambda: nested("[", 2_000_000),
    "flow mappings": lambda: nested("{a: ", 500_000),
    "block sequences": lambda: nested("- ", 1_000_000),
    "complex keys": lambda: nested("? ", 1_000_000),
    "aliases": lambda: laughs(9),
    "aliases of aliases in depth": lambda: "\n".join(
        ["- &a0 [x]", *(f"- &a{level} [*a{level - 1}]" for level in range(1, 2 * DEEPEST))]
    ),
    "merge keys": lambda: merges(9),
    "keys": lambda: keys(250_000),
    "values": lambda: f"[{'0,' * (MOST_VALUES + 10)}]",
    "unknown keys": lambda: keys(MOST_KEYS),
    "an alias to itself": lambda: "a: &a {b: *a}",
    "a scalar of 20 MB": lambda: "a: " + "x" * 20_000_000,
}
#: Files within the limits whose content is not as expected.
WITHIN = {"unknown keys", "a scalar of 20 MB"}
#: Arguments of `plow-twin` for each reader of a user's YAML files.
READERS = {
    "scene": ["simulate", "FILE", "--t-end", "1"],
    "mapping": ["live", "load.csv", "--map", "FILE"],
    "parameters": ["live", "load.csv", "--params", "FILE"],
}


#: Files for all readers but the first, because all use the same parser.
SOME_FILES = ("flow sequences", "aliases", "unknown keys")


@pytest.mark.parametrize("reader", READERS)
def test_files_with_excessive_content_are_refused_in_a_line(reader: str, tmp_path: Path) -> None:
    """Each command ends with exit code 2 and one line, without a signal, after at most 60 s of processor time."""
    files = list(FILES if reader == "scene" else SOME_FILES)
    for name in files:
        (tmp_path / f"{name}.yaml").write_text(FILES[name]())
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n0,0,0,0\n1,0,0,0\n")
    code = f"""
import resource, sys
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
from plow_twin.cli.app import run
for name in {files!r}:
    print(name, file=sys.stderr)
    code = run([word.replace("FILE", name + ".yaml") for word in {READERS[reader]!r}])
    print("code", code, file=sys.stderr)
"""
    completed = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "10000"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stderr[-2000:]
    errors = completed.stderr
    for name in files:
        _, _, rest = errors.partition(f"{name}\n")
        text, code_line, errors = rest.partition("\ncode ")
        assert code_line and errors.startswith("2\n"), (name, text[:500])
        lines = [line for line in text.splitlines() if ": got " in line]
        assert "Traceback" not in text and len(text) < 20_000, (name, text[:500])
        assert len(lines) == 1 or name in WITHIN, (name, text[:500])


@pytest.mark.parametrize(
    ("text", "got", "bound"),
    [
        (nested("[", DEEPEST + 1), f"{DEEPEST + 1} levels of nesting", DEEPEST),
        (laughs(9), "values by aliases", MOST_REPEATED),
        (merges(9), "values by aliases", MOST_REPEATED),
        (keys(MOST_KEYS + 1), f"{MOST_KEYS + 1} keys", MOST_KEYS),
        (f"[{'0,' * (MOST_VALUES + 1)}]", f"{MOST_VALUES + 1} values", MOST_VALUES),
    ],
    ids=["nesting", "aliases", "merge keys", "keys", "values"],
)
def test_an_exceeded_bound_is_named_with_its_place(text: str, got: str, bound: int) -> None:
    document, problems = load_yaml(text, "scene", "sections", most_values=MOST_VALUES)
    assert document is None and len(problems) == 1
    assert problems[0].key.startswith("line ")
    assert got in str(problems[0].got) and f"at most {bound} " in problems[0].expected


def test_content_within_the_bounds_is_read() -> None:
    deep = "[" * DEEPEST + "]" * DEEPEST
    assert load_yaml(deep, "scene", "sections")[1] == []
    shared = "head: &one {mass: 1}\nframe: {<<: *one, width: 2}\nloads: [*one, *one]"
    document, problems = load_yaml(shared, "scene", "sections")
    assert not problems and document["frame"] == {"mass": 1, "width": 2} and document["loads"] == [{"mass": 1}] * 2
    assert len(load_yaml(laughs(4), "scene", "sections")[0]["a4"]) == 9
    assert len(load_yaml(keys(MOST_KEYS), "scene", "sections")[0]) == MOST_KEYS


def test_a_file_without_end_is_read_up_to_the_largest_size(tmp_path: Path) -> None:
    document, problems = read_yaml(Path("/dev/zero"), "scene", "sections")
    assert document is None and problems[0].expected == f"at most {LARGEST_FILE >> 20} MiB of YAML"
    (tmp_path / "latin.yaml").write_bytes(b"a: \xff")
    assert "not UTF-8" in read_yaml(tmp_path / "latin.yaml", "scene", "sections")[1][0].expected


def test_a_limited_number_of_unknown_keys_is_listed(tmp_path: Path) -> None:
    from plow_twin.errors import SceneError
    from plow_twin.scene_file import loads_scene

    with pytest.raises(SceneError) as caught:
        loads_scene(keys(MOST_KEYS))
    assert len(caught.value.problems) == MOST_PROBLEMS
    with pytest.raises(SceneError) as caught:
        loads_scene("version: " + "x" * 1_000_000)
    assert len(str(caught.value)) < 2000 and "(1000000 characters)" in str(caught.value)


MAP = "excitation: {topic: /load, fields: {fx: x, fy: x, m: x}, stamp: log}"
#: Commands that read recordings, by kind of file.
COMMANDS = {
    "run": [["info", "FILE"], ["replay", "FILE", "-q"], ["export", "FILE", "-q", "--to", "npz", "--out", "OUT.npz"]],
    "foreign": [["analyse", "FILE", "--scene", "paper", "--map", "map.yaml", "--json"]],
    ".db3": [["analyse", "FILE", "--scene", "paper", "--json"]],
    ".csv": [["setup", "FILE"], ["analyse", "FILE", "--scene", "paper", "--json"]],
    ".npz": [
        ["study", "calibrate", "paper", "-q", "--unknown", "clearance.horizontal_m=0.01:0.05", "--recording", "FILE"],
    ],
}
FOREIGN = {"array", "texts", "nothing", "itself", "tree", "chain", "empty_lines", "topics"}
#: Files above a limit.
ABOVE = {"channels", "many_chunks", "topics", "columns", "line", "row", "unpacked"}
#: Files whose valid part is used.
WITH_LOSS = {"large_chunks", "lying_zstd", "lying_lz4", "lying_length"}
#: Largest memory of a command [MB], of which compiled code and libraries take 200 MB.
MOST_MB = 700
#: Commands for a recording that is not absurd.
PLAIN = (["info", "FILE"], ["replay", "FILE", "-q"], ["analyse", "FILE", "--scene", "paper", "--json"])
#: Program that runs each command in a fork of its own, with at most 20 s of processor time and 6 GB of address space.
#: Before that it runs `PLAIN`, so that libraries and kernels are loaded once.
RUNNER = """
import json, os, resource, sys
from contextlib import redirect_stdout
from io import StringIO
from plow_twin.cli.app import run
plain, asked = json.load(sys.stdin)
with redirect_stdout(StringIO()):
    for words in plain:
        run(words)
for name, words in asked:
    read, write = os.pipe()
    pid = os.fork()
    if not pid:
        resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
        resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30,) * 2)
        os.dup2(write, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.close(write)
        code = 99
        try:
            code = run(words)
        except BaseException as error:
            print(repr(error), file=sys.stderr)
        os._exit(code)
    os.close(write)
    with open(read) as said:
        text = said.read()
    _, status, used = os.wait4(pid, 0)
    print(json.dumps([name, words, os.waitstatus_to_exitcode(status), text, used.ru_maxrss >> 10]), flush=True)
"""


def test_absurd_recordings_end_with_one_line(tmp_path: Path) -> None:
    """No command ends by a signal or prints a traceback. Errors have one line, and time and memory are limited."""
    commands = []
    for file, make in MADE.items():
        name, _, ending = file.partition(".")
        kind = f".{ending}" if ending != "mcap" else "foreign" if name in FOREIGN else "run"
        folder = tmp_path / file
        folder.mkdir()
        make(folder / file)
        (folder / "map.yaml").write_text(MAP)
        for words in COMMANDS[kind]:
            places = {"FILE": file, "map.yaml": "map.yaml"}
            words = [*words, "--out", "OUT"] if words[0] in ("setup", "study") else words
            commands.append(
                (
                    name,
                    [
                        str(folder / places[word]) if word in places else word.replace("OUT", f"{folder}/out")
                        for word in words
                    ],
                )
            )
    (tmp_path / "plain.mcap").write_bytes(recorded())
    plain = [[word.replace("FILE", "plain.mcap") for word in words] for words in PLAIN]
    completed = subprocess.run(
        [sys.executable, "-c", RUNNER],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "10000"},
        input=json.dumps([plain, commands]),
        capture_output=True,
        text=True,
        check=False,
    )
    answers = [json.loads(line) for line in completed.stdout.splitlines()]
    assert len(answers) == len(commands), completed.stderr[-2000:]
    for name, words, code, text, memory_mb in answers:
        where = (name, words[0], code, memory_mb, text[-500:])
        unread = name == "header_file" and words[0] != "replay"  # these commands need no scene
        assert code in ((3,) if name in WITH_LOSS else (2,) if name in ABOVE else (0,) if unread else (1, 2)), where
        assert memory_mb < MOST_MB and "Traceback" not in text, where
        assert code == 3 or len(text.strip().splitlines()) <= 2, where


SCENE = """
version: 1
head: {mass_kg: {value: 2430, mark: given, source: "\\e]0;owned\\a[red]:smile:"}, inertia_kg_m2: 1265, rotation: paper}
frame: {width_m: 0.33, height_m: 0.27}
clearance: {horizontal_m: 0.025, vertical_m: 0.030}
contact: {law: hunt_crossley, stiffness: 9.6975e6, exponent: 1, damping: 0.72154}
loads: [{name: "\\e[2J\\u202e[bold]<b>", constant: {force_n: [1, 2], moment_n_m: 0}}]
"""


def _on_a_terminal(*commands: list[str], folder: Path) -> list[str]:
    """Return everything that the commands write to a terminal."""
    ours, theirs = pty.openpty()
    code = f"from plow_twin.cli.app import run\nfor words in {commands!r}: run(words), print('\\0', flush=True)"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200", "TERM": "xterm"},
        stdin=theirs, stdout=theirs, stderr=theirs,
    )  # fmt: skip
    os.close(theirs)
    written = b""
    try:
        while data := os.read(ours, 1 << 16):
            written += data
    except OSError:  # the program has closed its side of the terminal
        pass
    os.close(ours)
    process.wait()
    return written.decode().split("\0")[:-1]


def test_names_and_texts_of_a_file_do_not_control_a_terminal(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "wrong.yaml").write_text(SCENE + '"\\e]0;owned\\a": 1\n')
    (tmp_path / "\x1b]0;owned\x07.yaml").write_text("version: 2")
    expected: tuple[tuple[list[str], tuple[str, ...]], ...] = (
        (["info", "scene.yaml"], ("\\x1b]0;owned[red]:smile:", "\\x1b[2J\\u202e[bold]<b>")),
        (["info", "wrong.yaml"], ("\\x1b]0;owned\\x07",)),
        (["info", "\x1b]0;owned\x07.yaml"], ("\\x1b]0;owned\\x07.yaml",)),
        (["live", "load.csv", "--set", "\x1b]0;owned\x07=1"], ("\\x1b]0;owned\\x07",)),
        (["simulate", "--\x1b]0;owned\x07"], ("\\x1b]0;owned\\x07",)),
    )
    output = _on_a_terminal(*(arguments for arguments, _ in expected), folder=tmp_path)
    for (arguments, shown), written in zip(expected, output, strict=True):
        assert not any(acting in written for acting in ("\x1b]", "\x1b[2J", "\x07", "\u202e")), (arguments, written)
        assert all(text in written for text in shown), (arguments, written)


@pytest.mark.parametrize("content", [b"x" * 70_000, b"\0\0", b"p\x1b[2Jw", b"\xff\xfe"])
def test_an_invalid_secret_file_is_named_and_not_shown(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "secret"
    path.write_bytes(content)
    outputs = Credentials({"influx": {"token_file": "secret"}}, tmp_path)
    for read in (
        lambda: secret(path, "MQTT_PASSWORD"),
        lambda: PageAccess.of("0.0.0.0:8070", path),
        lambda: outputs.secret("influx", "token_file", "INFLUX_TOKEN"),
    ):
        with pytest.raises(
            InputError, match=f"^{path}: line 1: got '.* bytes', expected a password or token"
        ) as refused:
            read()
        assert repr(content)[2:-1][:4] not in str(refused.value).removeprefix(str(path))
    path.write_text("s3cret, at least 16 characters\r\nmore")
    assert (
        secret(path, "MQTT_PASSWORD") == outputs.secret("influx", "token_file", "") == "s3cret, at least 16 characters"
    )


@pytest.mark.parametrize(("count", "got"), [(20_000, "got 20004 columns"), (100_000, "more than 262144 bytes")])
def test_a_header_too_wide_is_refused_before_a_row_is_read(tmp_path: Path, count: int, got: str) -> None:
    path = tmp_path / "wide.csv"
    path.write_text("t,fx,fy,m," + ",".join(f"c{i}" for i in range(count)) + "\n0,1,2,3" + ",0" * count + "\n")
    with pytest.raises(ExcessError, match=got):
        Files([path], follow=False).topics()
