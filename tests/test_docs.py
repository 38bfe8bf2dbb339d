"""The pages tell the truth: links and anchors resolve, and the files, commands and options that they name exist."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import pytest

from sim_hil.benchmark.results.compare import compared
from sim_hil.benchmark.results.store import read_results
from sim_hil.benchmark.results.summary import summarise

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = next(folder for folder in Path(__file__).resolve().parents if (folder / "pyproject.toml").is_file())
RUNS = ROOT / "docs/runs"
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
FOLDERS = sorted({"docs", "tests", *(path.parent.name for path in ROOT.glob("*/__init__.py"))})
NESTED = {"edge-install", "edge-calib", "edge-bench", "edge-replay"}
"""Commands whose subcommands have parsers of their own."""
MAX_README_LINES = 120

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#{1,6} (.+)$", re.MULTILINE)
CODE = re.compile(r"^```.*?^```|^ {4}[^\n]*$|`[^`\n]+(?:\n[^`\n]+)?`", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?<![\w./-])edge-[a-z]+(?![\w-])")
TARGET = re.compile(r"^\s*make ([a-z][a-z-]*)")
MODULE = re.compile(r"-m ((?:" + "|".join(FOLDERS) + r")(?:\.\w+)+)")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
REPOSITORY_PATH = re.compile(r"(?<![\w./~-])(?:" + "|".join(FOLDERS) + r")/[\w./-]*")
OTHER_PROGRAM = re.compile(
    r"(?<![\w-])(?:ray|torchrun|pip|apt-get|docker|nft|git|ls|sed|systemctl|systemd-run|systemd-tmpfiles"
    r"|ros2 topic|ros2 param) "
)


@dataclass(frozen=True)
class Use:
    """A command line in a page: `edge-NAME [SUBCOMMAND]` with the long options after it."""

    page: str
    command: str
    subcommand: str
    options: tuple[str, ...]


def code(page: Path) -> list[str]:
    """Code blocks and code spans; continued lines are joined, comments dropped."""
    lines: list[str] = []
    for match in CODE.finditer(page.read_text(encoding="utf-8")):
        text = match.group()
        is_span = text.startswith("`") and not text.startswith("```")
        lines += [text.strip("`").replace("\n", " ")] if is_span else text.strip("`").splitlines()
    return [re.split(r"\s#", line)[0] for line in "\n".join(lines).replace("\\\n", " ").splitlines()]


def uses() -> Iterator[Use]:
    for page in PAGES:
        for line in code(page):
            edges = [*(match.start() for match in COMMAND.finditer(line)), len(line)]
            for start, end in pairwise(edges):
                words = line[start:end].split()
                named = words[1] if len(words) > 1 and re.fullmatch(r"[a-z]+", words[1]) else ""
                options = tuple(OPTION.findall(OTHER_PROGRAM.split(line[start:end])[0]))
                yield Use(page.name, words[0], named if words[0] in NESTED else "", options)


@cache
def scripts() -> dict[str, str]:
    """Entry points by command."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {str(name): str(target) for name, target in project["scripts"].items()}


@cache
def anchors(page: Path) -> frozenset[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in HEADING.findall(text))
    return frozenset(re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in plain)


@cache
def known_options() -> frozenset[str]:
    """Every long option that some parser of this repository defines."""
    sources = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if folder != "tests")
    return frozenset(
        option for path in sources for option in re.findall(r'"(--[a-z][a-z0-9-]*)"', path.read_text(encoding="utf-8"))
    ) | {"--help"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_and_anchor_resolves(page: Path) -> None:
    text = CODE.sub("", page.read_text(encoding="utf-8"))
    for link in LINK.findall(text):
        if link.startswith(("https://", "http://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_relative_to(ROOT) and target.exists(), f"{page.name}: {link}: no such file"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}: no such heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_repository_path_in_code_exists(page: Path) -> None:
    named = {path.rstrip(".") for line in code(page) for path in REPOSITORY_PATH.findall(line)}
    assert not {path for path in named if not (ROOT / path).exists()}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_is_an_entry_point(page: Path) -> None:
    assert set(COMMAND.findall(page.read_text(encoding="utf-8"))) <= set(scripts())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_make_target_exists(page: Path) -> None:
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert {name for line in code(page) for name in TARGET.findall(line)} <= targets


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_python_module_that_is_run_exists(page: Path) -> None:
    for name in {name for line in code(page) for name in MODULE.findall(line)}:
        path = ROOT / name.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), f"{page.name}: python -m {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_long_option_is_defined_somewhere(page: Path) -> None:
    ours = (OTHER_PROGRAM.split(line)[0] for line in code(page))
    assert not {option for line in ours for option in OPTION.findall(line)} - known_options()


@pytest.mark.slow
@pytest.mark.parametrize("command", sorted(scripts()))
def test_every_option_beside_a_command_is_in_its_help(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    named = [use for use in uses() if use.command == command]
    assert named, f"no page shows {command}"
    module, _, function = scripts()[command].partition(":")
    main = getattr(import_module(module), function)
    for subcommand in {use.subcommand for use in named}:
        monkeypatch.setattr(sys, "argv", [command, *([subcommand] if subcommand else []), "--help"])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 0
        shown = set(OPTION.findall(capsys.readouterr().out.split("examples:")[0])) | {"--help"}
        for use in named:
            if use.subcommand == subcommand:
                assert set(use.options) <= shown, f"{use.page}: {command} {subcommand}: {set(use.options) - shown}"


def test_the_published_run_has_the_rates_of_its_page() -> None:
    rates = summarise(read_results(RUNS / "dynanav-fresh-nano"))
    sr, cr = (f"{rates[key]:.1f} ({' to '.join(f'{end:.1f}' for end in rates[f'{key}_ci95'])})" for key in ("sr", "cr"))
    row = f"| {rates['episodes']} | {rates['episodes'] * rates['sr'] / 100:.0f} | {sr} | {rates['spl']:.1f} | {cr} |"
    assert row in (ROOT / "docs/results.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("run", sorted(RUNS.glob("dynanav-fresh-nano-*")), ids=lambda run: run.name)
def test_a_published_run_under_another_condition_differs_as_its_page_says(run: Path) -> None:
    found = compared(RUNS / "dynanav-fresh-nano", run)
    cells = [str(found["episodes"])]
    for rate in (found["differences"]["sr"], found["differences"]["cr"]):
        after, before = (f"{found['episodes'] * rate[key] / 100:.0f}" for key in ("after", "before"))
        low, high = rate["ci95"]
        cells += [f"{after} instead of {before}", f"{rate['difference']:+.1f} ({low:+.1f} to {high:+.1f})"]
    assert f"| {' | '.join(cells)} |" in (ROOT / "docs/results.md").read_text(encoding="utf-8")


def test_the_readme_stays_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MAX_README_LINES


@pytest.mark.parametrize(
    ("question", "page", "answer"),
    [
        ("Where is a velocity limited?", "docs/architecture.md", "edge/motion/controller.py"),
        ("What happens when the camera freezes?", "docs/architecture.md", "camera-frozen"),
        ("How do I add a CAN robot?", "docs/your_robot.md", "firmware_bridge/robots/example_can.toml"),
    ],
)
def test_the_readme_leads_a_newcomers_question_to_its_answer(question: str, page: str, answer: str) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    line = next((line for line in readme.splitlines() if question in line), "")
    assert f"]({page}" in line, f"README: no line asks {question!r} and links {page}"
    assert answer in (ROOT / page).read_text(encoding="utf-8")
