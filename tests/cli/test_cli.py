"""The command line's contract: exit codes, the last JSON line, progress lines, options."""

import io
import json
import os
import shlex
import shutil
import signal
import string
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from pydantic import Field

from limber.cli import main, terminal
from limber.cli.main import call
from limber.cli.stage_command import StageCommand
from limber.core.errors import Cancelled, ConvergenceError, InputError, SafetyStop
from limber.core.files import caches
from limber.core.progress import SILENT
from limber.geometry.settings import ReconstructSettings
from limber.stages.command_line import command_line
from limber.stages.registry import stage_class, stage_summaries
from limber.stages.stage import About, Tool


class Probe(Tool):
    """Probe."""

    about = About("probe")

    size: float = Field(0.5, gt=0, description="Size [m].")
    deep: bool = Field(False, description="Go deep.")
    goal: tuple[float, float, float] | None = Field(None, description="Goal [m].")
    fractions: tuple[float, ...] = Field((0.2, 0.4), description="Fractions.")


def invoke(function, arguments, capfd, base=Probe, **about):
    """Run the command of a stage that does ``function(stage, progress)``; return exit code and
    standard output's lines."""
    class Tested(base):
        """Probe."""

        def run(self, progress=SILENT):
            return function(self, progress)
    Tested.about = About("probe", **about)
    with pytest.raises(SystemExit) as stop:
        StageCommand(Tested).main(arguments, standalone_mode=False)
    return stop.value.code, capfd.readouterr().out.splitlines()


def test_result_is_the_last_json_line(capfd):
    """--json ends with one object that has the contract's keys and the result's."""
    def function(_stage, progress):
        progress(0.5, "half", count=2)
        progress.warn("careful")
        return {"tet_count": 12}
    code, lines = invoke(function, ["--json", "--progress", "json"], capfd)
    assert code == 0
    first, last = json.loads(lines[0]), json.loads(lines[-1])
    assert (first["progress"], first["message"], first["count"]) == (0.5, "half", 2)
    assert last["command"] == "probe"
    assert last["status"] == "done"
    assert last["error"] is None
    assert last["warnings"] == ["careful"]
    assert last["tet_count"] == 12
    assert last["seconds"] >= 0


@pytest.mark.parametrize(("failure", "code", "status"), [
    (InputError("a", "b", "c"), 2, "failed"), (ConvergenceError("a"), 3, "failed"),
    (SafetyStop("a"), 4, "failed"), (Cancelled(), 130, "cancelled"),
    (KeyboardInterrupt(), 130, "cancelled"), (ZeroDivisionError("bug"), 3, "failed"),
    (MemoryError(), 3, "failed"),
])
def test_exit_codes(failure, code, status, capfd):
    """Each kind of failure ends with its exit code, and --json still ends with one object."""
    def function(_stage, _progress):
        raise failure
    got, lines = invoke(function, ["--json"], capfd)
    assert got == code
    assert json.loads(lines[-1])["status"] == status
    assert json.loads(lines[-1])["error"]


@pytest.mark.parametrize(("arguments", "wanted"), [
    ([], {}),
    (["--size", "2", "--deep", "--goal", "1", "2", "3", "--fractions", "0.5,0.9"],
     {"size": 2, "deep": True, "goal": (1, 2, 3), "fractions": (0.5, 0.9)}),
    (["--size", "8mm", "--goal", "-1 cm", "2e1mm", ".5"],
     {"size": 0.008, "goal": (-0.01, 0.02, 0.5)}),
])
def test_settings_become_options(arguments, wanted, capfd):
    """Every field is an option with its type; the stage that runs has what was typed."""
    seen = []

    def function(stage, _progress):
        seen.append(stage)
        return {}
    code, _ = invoke(function, arguments, capfd)
    assert code == 0
    assert [dict(stage) for stage in seen] == [dict(Probe(**wanted))]
    assert [stage.model_fields_set for stage in seen] == [wanted.keys()]


@pytest.mark.parametrize(("arguments", "wanted"), [
    (["--root", "auto"], "auto"), (["--root=auto"], "auto"),
    (["--root", "-900", "793", "2060.5"], (-900.0, 793.0, 2060.5)), ([], None)])
def test_a_word_may_stand_for_the_numbers_of_an_option(arguments, wanted, capfd):
    """As it is typed; a command line made of it is read the same."""
    seen = []

    class Base(ReconstructSettings, Tool):
        """Probe."""

    def code_of(given):
        def function(stage, _progress):
            seen.append(stage)
            return {}
        return invoke(function, given, capfd, Base)[0]
    assert code_of(arguments) == 0 and code_of(command_line(seen[0])) == 0
    assert [settings.root for settings in seen] == [wanted, wanted]
    with pytest.raises(click.UsageError, match="extra arguments"):
        code_of(["--root", "auto", "1", "2"])
    assert code_of(["--root", "1", "auto", "2"]) == 2


@pytest.mark.parametrize("arguments", [["--size=-1"], ["--size=nan"], ["--fractions", "0.1,x"],
                                       ["--size=4N"], ["--fractions", "0.1 mm,0.2 mm"]])
def test_refused_setting_is_named(arguments, capfd):
    """A value out of range is a usage error (2); the last JSON line names option and value."""
    code, lines = invoke(lambda *_: {}, [*arguments, "--json"], capfd)
    assert code == 2
    assert arguments[0].split("=")[0] in json.loads(lines[-1])["error"]


@pytest.mark.slow
def test_every_listed_command_exists():
    """`limber --help` lists only commands whose module loads and has help."""
    for name in main.command_summaries():
        command = main.main.get_command(click.Context(main.main), name)
        assert command is not None
        assert command.help


def test_an_unknown_command_or_option_is_answered_with_those_like_it(capfd):
    """One that is like none points at the list."""
    for arguments, told in ((["recnstruct"], "Did you mean reconstruct?"),
                            (["new-cel"], "Did you mean robot new-cell?"),
                            (["robot", "chek"], "Did you mean 'check'?"),
                            (["simulate", "x.branch", "--duratoin", "1"], "--duration"),
                            (["xyzzy"], "`limber --help` lists all.")):
        assert main.call([*arguments, "--json"]) == 2
        said = capfd.readouterr()
        assert told in said.err and said.err.startswith("error: ")
        assert told in json.loads(said.out)["error"] and json.loads(said.out)["status"] == "failed"


class Reader(Tool):
    """Probe."""

    about = About("probe")
    scan: Path = Field(description="A scan.", json_schema_extra={"argument": True})


def read(capfd, *arguments):
    """The path that a stage got, its content, exit code and standard output's lines."""
    got = []

    def function(stage, _progress):
        got.append((stage.scan, stage.scan.read_bytes()))
        return {}
    return got, *invoke(function, [*arguments, "--progress", "none"], capfd, Reader)


@pytest.mark.parametrize(("content", "name"), [
    (b"x,y,z\n0,1,2\n", "stdin.txt"), (b"ply\nformat ascii 1.0\n", "stdin"),
    (b"\x93NUMPY\x01\0", "stdin")])
def test_standard_input_is_a_file(content, name, capfd, monkeypatch):
    """It is read to its end, and recognised as a file would be."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content + 9000 * b"\n")))
    [(path, held)], code, _ = read(capfd, "-")
    assert code == 0 and path.name == name and held.strip() == content.strip()
    assert len(held) == len(content) + 9000 and not path.exists()


def test_a_quoted_pattern_names_one_file(tmp_path, capfd):
    """Of several one must be named; a file of that name is meant before a pattern."""
    (tmp_path / "one.xyz").write_text("1")
    assert read(capfd, str(tmp_path / "o*.xyz"))[0] == [(tmp_path / "one.xyz", b"1")]
    (tmp_path / "two.xyz").write_text("2")
    got, code, lines = read(capfd, str(tmp_path / "*.xyz"), "--json")
    error = json.loads(lines[-1])["error"]
    assert not got and code == 2 and "2 files match" in error and "limber batch" in error
    (tmp_path / "scan[1].xyz").write_text("3")
    assert read(capfd, str(tmp_path / "scan[1].xyz"))[0] == [(tmp_path / "scan[1].xyz", b"3")]


@pytest.mark.parametrize(("about", "said"), [
    ({}, "warning: careful\n"), ({"moves_robot": "always"}, "a table\nwarning: careful\n")])
def test_a_quiet_command_prints_warnings_and_errors_only(about, said, capsys):
    """Lines for the person at a robot stay."""
    class Quiet(Probe):
        """Probe."""

        def run(self, progress=SILENT):
            progress.say("a table")
            progress.warn("careful")
            return {"tet_count": 12}
    Quiet.about = About("probe", **about)
    with pytest.raises(SystemExit, match="0"):
        StageCommand(Quiet).main(["--quiet"], standalone_mode=False)
    assert capsys.readouterr() == ("", said)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_and_options(shell, capfd, monkeypatch):
    """The script asks the program, which answers from its own parsers."""
    assert main.call(["completion", shell]) == 0
    assert f"_LIMBER_COMPLETE={shell}_complete" in capfd.readouterr().out
    monkeypatch.setenv("_LIMBER_COMPLETE", f"{shell}_complete")
    for typed, word, wanted in (("limber reco", 1, "reconstruct"),
                                ("limber energy --samp", 2, "--samples")):
        monkeypatch.setenv("COMP_WORDS", typed)
        # fish hands over the word itself, the others its number.
        monkeypatch.setenv("COMP_CWORD", typed.split()[-1] if shell == "fish" else str(word))
        main.call([])
        assert wanted in capfd.readouterr().out


def test_values_are_shown_in_full_on_demand(capfd):
    """Short lines by default, every value with --verbose, one object with --json."""
    def printed(*arguments):
        return invoke(lambda *_: {"tet_count": 12}, arguments, capfd,
                      found=("{tet_count} tetrahedra.",), where="a.branch",
                      then="limber simulate a.branch")[1]
    short = printed()
    assert short[:3] == ["12 tetrahedra.", "in    a.branch", "next  limber simulate a.branch"]
    assert "--verbose" in short[3] and len(short) == 4
    assert printed("-v")[0] == "tet_count: 12"
    assert json.loads(printed("--json")[0])["tet_count"] == 12


REQUIRED = [(name, model, field) for name in stage_summaries()
            for model in (stage_class(name),) for field, about in model.model_fields.items()
            if about.is_required() and not (about.json_schema_extra or {}).get("argument")]


@pytest.mark.parametrize(("name", "model", "field"), REQUIRED)
def test_a_forgotten_option_is_named_and_a_value_proposed(name, model, field, capfd):
    """Of every stage: one line, without Python's words; what it proposes is taken."""
    arguments = [f"some/{key}.xyz" for key, about in model.model_fields.items()
                 if (about.json_schema_extra or {}).get("argument")]
    assert main.call([name, *arguments]) == 2
    said = capfd.readouterr().err.strip()
    flag = "--" + field.replace("_", "-")
    assert said.startswith("error: Missing option") and "\n" not in said
    assert flag in said and "Path(" not in said and "Field required" not in said
    proposed = shlex.split(said.partition("for example: ")[2])
    short = (model.model_fields[field].json_schema_extra or {}).get("short", flag)
    assert not proposed[proposed.index(short) + 1].isupper()
    main.call([name, *arguments, *proposed])
    assert "Missing" not in capfd.readouterr().err


def test_a_forgotten_output_is_named_after_the_input(capfd):
    """`limber reconstruct ten.xyz` proposes -o ten.branch."""
    assert main.call(["reconstruct", "scans/ten.xyz"]) == 2
    assert capfd.readouterr().err == (
        "error: Missing option -o (--output). The branch folder to make. With a folder of "
        "scans: where to make the branch folders. Add, for example: -o ten.branch\n")


HEAVY = {"numpy", "pydantic", "scipy", "rich", "trimesh", "matplotlib"}


def test_help_is_quick_and_imports_nothing_heavy():
    """`limber --help` loads none of the packages that take long; a stage's no numerical one."""
    program = "import sys; from limber.cli import main\n"
    for arguments, heavy in (([], HEAVY), *(
            ([stage], {"scipy", "trimesh", "matplotlib"}) for stage in (
                "simulate", "estimate"))):
        program += (f"assert main.call({[*arguments, '--help']}) == 0\n"
                    f"assert not {heavy} & set(sys.modules), {heavy} & set(sys.modules)\n")
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has /dev/full")
def test_standard_output_that_takes_nothing_is_told(monkeypatch, capfd):
    """The result is lost, which one line says."""
    for arguments in (["--help"], ["cache", "--json"]):
        with open("/dev/full", "w") as full:
            monkeypatch.setattr(sys, "stdout", full)
            assert main.call(arguments) == 3
        told = capfd.readouterr().err
        assert "error: Standard output cannot be written" in told and "Traceback" not in told


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", None)])
def test_interrupt_ends_with_130(kind):
    """Ctrl-C, SIGTERM and a closed terminal end a command with 130 and the cancelled status."""
    program = ("import signal, time\nfrom limber.cli import main, stage_command\n"
               "from limber.stages.stage import About, Tool\n"
               "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
               "class Probe(Tool):\n"
               "    about = About('probe')\n"
               "    def run(self, progress=None):\n"
               "        print('ready', flush=True); time.sleep(30)\n"
               "main._terminate_like_interrupt()\n"
               "stage_command.StageCommand(Probe).main(['--json'], standalone_mode=False)")
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True,
                               stderr=subprocess.DEVNULL)
    assert process.stdout.readline().strip() == "ready"
    time.sleep(0.1)
    process.send_signal(kind)
    out, _ = process.communicate(timeout=10)
    assert process.returncode == 130
    assert json.loads(out.splitlines()[-1])["status"] == "cancelled"


def test_help_names_default_and_range_as_typed():
    """A switch's default is the switch, a vector's has spaces, a list's commas; bounds are told."""
    class Ranged(Tool):
        """Settings with every kind of default."""

        about = About("probe")

        samples: int = Field(150, ge=30, le=5000, description="Samples.")
        upright: bool = Field(True, description="Turn it.")
        damping: tuple[float, float] = Field((0.5, 0.002), description="Damping [1/s, s].")
        fractions: tuple[float, ...] = Field((0.2, 0.8), description="Places.")

    probe = StageCommand(Ranged)
    told = " ".join(probe.get_help(click.Context(probe)).split())
    for text in ("[default: 150; at least 30; at most 5000]", "[default: --upright]",
                 "[default: 0.5 0.002]", "[default: 0.2,0.8]"):
        assert text in told


# What a person reads on a terminal.


def test_result_has_few_digits_and_nothing_empty():
    """Numbers to five digits, lists on a line, what is nested indented, empty entries left out."""
    result = {"young_pa": [95342689.1366041, 1e8], "converged": True, "picture": None, "ties": [],
              "count": 2280, "quality": {"ratio": 0.99583506, "bad": None},
              "bridges": [{"from": [0.1234567, 0.0], "length": 0.0374492}]}
    assert list(terminal.result_lines(result)) == [
        "young_pa: [9.5343e+07, 1e+08]", "converged: yes", "count: 2280", "quality:",
        "  ratio: 0.99584", "bridges:", "  from [0.12346, 0], length 0.037449"]
    *_, last = terminal.result_lines({"costs": list(range(30))})
    assert last == "  and 18 more (--json shows all)"


def test_table_is_aligned():
    """Every row is as wide as the header."""
    lines = list(terminal.table_lines([["point", "E [MPa]"], ["1", "95.34"]]))
    assert lines == ["point  E [MPa]", "    1    95.34"]


def test_lines_of_what_was_found_have_units_and_need_their_values():
    """A line whose value is not there is left out; a vector is told by its length."""
    values = {"length_m": 0.0042, "young_pa": [2.5e9, None], "moved_m": [3.0, 0.0, 4.0],
              "share": 0.123, "why": None, "one": 1, "two": 2000, "best": {"force_n": 1.25}}
    lines = ["{length_m:m} long", "{young_pa[0]:Pa}", "{young_pa[1]:Pa}", "{moved_m:|m} away",
             "{share:share} of it", "{one:#branch/branches}, {two:#branch/branches}", "{why}",
             "{nothing}", "{best[force_n]:N}",
             lambda result: f"{len(result)} values", lambda result: None,
             lambda result: result["of an older program"]]
    assert list(terminal.found_lines(lines, values)) == [
        "4.2 mm long", "2.5 GPa", "5 m away", "12.3 % of it",
        "1 branch, 2,000 branches", "1.25 N", "8 values"]


def test_the_end_says_what_where_and_what_next():
    """A command that is proposed can be typed as it stands."""
    values = {"branch_folder": Path("my trees/a.branch"), "name": None}
    then = terminal.command_to_type("limber estimate {branch_folder}", values)
    assert then == "limber estimate 'my trees/a.branch'"
    assert terminal.command_to_type("limber plan {branch_folder} --name {name}", values) == ""
    assert terminal.command_to_type("{name:if}limber verify {branch_folder}", values) == ""
    assert terminal.command_to_type("{branch_folder:if}limber doctor", values) == "limber doctor"
    for ended, command in ((True, "energy"), (False, "estimate")):
        assert terminal.command_to_type("limber {ended:energy/estimate}", {"ended": ended}
                                        ) == f"limber {command}"
    assert terminal.closing_lines(["Done."], "a.branch", then) == [
        "Done.", "in    a.branch", f"next  {then}"]
    assert terminal.closing_lines(["Done."]) == ["Done."]


@pytest.mark.parametrize("name", list(stage_summaries()))
def test_every_stage_says_what_it_found_and_proposes_commands_that_exist(name):
    """Its lines are written in known units; the command after it is one of ours."""
    stage = stage_class(name).about
    assert stage.found
    for line in (line for line in stage.found if isinstance(line, str)):
        for _text, field, spec, _conversion in string.Formatter().parse(line):
            if field is not None and spec:
                assert spec.lstrip("|") in terminal.UNITS or spec[0] in ".#", (line, spec)
    if stage.then:
        program, command, *_rest = stage.then.rpartition(":if}")[2].split()
        assert program == "limber"
        assert set(command.strip("{}").rpartition(":")[2].split("/")) <= set(stage_summaries())


# `limber cache` and `limber bug-report`.

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """A cache of three files of 1,000 bytes, the first used longest ago."""
    monkeypatch.setattr(caches, "cache_folder", lambda: tmp_path / "cache")
    (tmp_path / "cache" / "tetrahedra").mkdir(parents=True)
    for age, name in enumerate(("new", "middle", "old")):
        path = tmp_path / "cache" / "tetrahedra" / f"{name}.npz"
        path.write_bytes(bytes(1000))
        os.utime(path, (1e9 - 100 * age,) * 2)
    return tmp_path / "cache" / "tetrahedra"


def _result(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_cache_keeps_what_was_used_last(kept, capsys):
    """Shown, trimmed to a size, cleared; a size that is none is refused."""
    assert call(["cache", "--json"]) == 0
    assert _result(capsys)["caches"] == {"tetrahedra": {"file_count": 3, "byte_count": 3000}}
    assert call(["cache", "--limit", "0.002 MB", "--json"]) == 0
    assert _result(capsys)["freed_bytes"] == 1000
    assert sorted(path.stem for path in kept.iterdir()) == ["middle", "new"]
    assert call(["cache", "--limit", "much"]) == 2
    assert call(["cache", "--clear"]) == 0 and not list(kept.iterdir())


def test_a_bug_report_holds_the_manifest_and_no_data_unasked(tmp_path, capsys):
    """A damaged folder is told as such; with --data its files go along, but none of 40 GB."""
    folder = shutil.copytree(EXAMPLE, tmp_path / "a.branch")
    os.truncate(folder / "mesh.vtu", 40 << 30)
    out = tmp_path / "bug.zip"
    assert call(["bug-report", str(folder), "-o", str(out), "--note", "it broke", "--json"]) == 0
    assert _result(capsys)["damaged_count"] == 1
    with zipfile.ZipFile(out) as archive:
        assert archive.namelist() == ["report.json", "branch/branch.json"]
        told = json.loads(archive.read("report.json"))
    assert told["note"] == "it broke" and told["damages"][0]["name"] == "mesh.vtu"
    assert told["doctor"]["python"] and told["files"]["cloud.ply"]["bytes"] > 0
    (folder / "branch.json").write_text("{")
    assert call(["bug-report", str(folder), "-o", str(out), "--data", "--json"]) == 0
    assert not _result(capsys)["opens"]
    with zipfile.ZipFile(out) as kept:
        assert {"branch/cloud.ply", "branch/mesh.vtu"} - {*kept.namelist()} == {"branch/mesh.vtu"}


def test_a_bug_report_of_a_scan(tmp_path, capsys):
    """One that no branch came of: its size and checksum, with --data the file."""
    scan, out = tmp_path / "scan.ply", tmp_path / "bug.zip"
    scan.write_bytes(b"ply, more or less")
    for words, names in (((), ["report.json"]), (("--data",), ["report.json", "scan.ply"])):
        assert call(["bug-report", str(scan), "-o", str(out), *words, "--json"]) == 0
        with zipfile.ZipFile(out) as archive:
            assert archive.namelist() == names
            assert json.loads(archive.read("report.json"))["files"]["scan.ply"]["bytes"] == 17
    assert call(["bug-report", str(tmp_path / "none"), "-o", str(out)]) == 2
    capsys.readouterr()


def test_doctor_names_what_is_wrong_with_a_cache(tmp_path, monkeypatch, capsys):
    """Empty files, and a disk without room."""
    (tmp_path / "tetrahedra").mkdir()
    (tmp_path / "tetrahedra" / "a.npz").write_bytes(b"")
    (tmp_path / "tetrahedra" / "b.npz").write_bytes(bytes(2_000_000))
    monkeypatch.setattr(caches, "cache_folder", lambda: tmp_path)
    assert call(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["caches"]["tetrahedra"]
    assert told.startswith("2 files, 2 MB; 1 of them empty")
    monkeypatch.setattr("shutil.disk_usage", lambda _place: SimpleNamespace(free=5e6))
    assert call(["doctor", "--json"]) == 0
    assert "its disk has 5 MB left" in json.loads(capsys.readouterr().out)["caches"]["tetrahedra"]
