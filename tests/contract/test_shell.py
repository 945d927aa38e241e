"""`./tools/run` on machines that lack something: what it makes, in which order, and what it says."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.places import ROOT
from tests.scheduling import DEMO, SLEEPING, STREAMING, Scheduling, order

COREUTILS = ("sh", "dirname", "readlink", "cksum", "cat", "rm", "mv", "mkdir", "cp", "chmod", "grep", "env", "flock")
LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libSM.so.6": "libsm6",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libgomp.so.1": "libgomp1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
}

# Stands in for a Python: logs how it is called; `-m venv` copies it; pip fails while a file `no-network` is there, and
# the environment's own pip is missing while `no-ensurepip` is.
FAKE_PYTHON = """#!/bin/sh
case "$*" in
  *"-m venv"*)
    for last; do :; done
    echo "venv VERSION $*" >>"$LOG"; rm -rf "$last"; mkdir -p "$last/bin"; cp "$0" "$last/bin/python" ;;
  *"-m pip --version"*) ;;
  *"-m pip"*) echo "pip $*" >>"$LOG"; [ ! -e "$LOG.no-network" ] ;;
  *"-c import ensurepip"*) [ ! -e "$LOG.no-ensurepip" ] ;;
  *"-c import sys; print"*) echo pythonVERSION-venv ;;
  *"-c import sys; raise"*) for a; do [ "$a" != VERSION ] || exit 0; done; exit 1 ;;
  *) echo "run $*" >>"$LOG"; echo "in $(pwd)"; for a; do echo "<$a>"; done ;;
esac
"""


def python(version: str) -> str:
    """A program that says it is this Python."""
    return FAKE_PYTHON.replace("VERSION", version)


def listing(*libraries: str) -> str:
    """An ldconfig that knows these libraries."""
    lines = "".join(f"\t{name} (libc6,x86-64) => /lib/{name}\n" for name in libraries)
    return f"#!/bin/sh\ncat <<'END'\n{lines}END\n"


@dataclass(frozen=True)
class Machine:
    """A pretended machine: its PATH, a copy of the project under a path with a space, and a log of the calls."""

    tools: Path
    project: Path
    log: Path

    def install(self, name: str, script: str) -> None:
        """Puts a program on the PATH."""
        path = self.tools / name
        path.unlink(missing_ok=True)
        path.write_text(script)
        path.chmod(0o755)

    def run(self, *arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        """Runs tools/run there, with no terminal."""
        return subprocess.run(
            [str(self.project / "tools" / "run"), *arguments],
            env={"PATH": str(self.tools), "LOG": str(self.log), "PYTHONPATH": "/opt/ros"},
            cwd=cwd or self.tools,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
        )

    def lines(self) -> list[str]:
        """The logged calls since the last time, in order."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return lines

    def calls(self) -> list[str]:
        """The first word of each logged call since the last time, in order."""
        return [line.split()[0] for line in self.lines()]

    def locks(self) -> list[str]:
        """The locks installed since the last time, in order."""
        return [line.rpartition("/")[2] for line in self.lines() if line.endswith(".lock")]


@pytest.fixture
def machine(tmp_path: Path, repository: Path) -> Machine:
    """A machine with every system package, an ordinary user and Python 3.11, and nothing else."""
    tools, project = tmp_path / "bin", tmp_path / "a folder" / "weldcal"
    tools.mkdir()
    (project / "tools").mkdir(parents=True)
    for name in ("pyproject.toml", "requirements.lock", "requirements-dev.lock", "tools/run"):
        shutil.copy(repository / name, project / name)
    for name in COREUTILS:
        found = shutil.which(name)
        assert found is not None
        (tools / name).symlink_to(found)
    made = Machine(tools, project, tmp_path / "log")
    made.install("ldconfig", listing(*LIBRARIES))
    made.install("id", "#!/bin/sh\necho 1000\n")
    made.install("python3.11", python("3.11"))
    return made


@pytest.mark.parametrize("shell", ["sh", "dash", "bash"])
def test_the_script_is_plain_shell(repository: Path, shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    subprocess.run([shell, "-n", str(repository / "tools" / "run")], check=True)
    assert os.access(repository / "tools" / "run", os.X_OK)


def test_the_first_run_makes_the_environment_and_the_second_starts_at_once(machine: Machine) -> None:
    first = machine.run("--version")
    assert first.returncode == 0, first.stderr
    assert machine.calls() == ["venv", "pip", "pip", "run"]
    assert "installing the locked dependencies" in first.stderr
    assert machine.run("--version").stderr == ""
    assert machine.calls() == ["run"]


def test_only_what_the_lock_names_is_installed(machine: Machine) -> None:
    machine.run("--version")
    locked, own = [line for line in machine.log.read_text().splitlines() if line.startswith("pip")]
    assert "--require-hashes" in locked
    assert "--no-deps" in own
    assert "--no-build-isolation" in own


def test_arguments_and_the_current_directory_arrive_unchanged(machine: Machine, tmp_path: Path) -> None:
    here = tmp_path / "data here"
    here.mkdir()
    said = machine.run("calibrate", "my scans", "--out", "a*b", cwd=here).stdout.splitlines()
    assert said[0] == f"in {here}"
    assert said[-4:] == ["<calibrate>", "<my scans>", "<--out>", "<a*b>"]


def test_it_works_through_a_link(machine: Machine, tmp_path: Path) -> None:
    link = tmp_path / "weldcal"
    link.symlink_to(machine.project / "tools" / "run")
    linked = Machine(machine.tools, machine.project, machine.log)
    finished = subprocess.run([str(link), "x"], env={"PATH": str(linked.tools), "LOG": str(linked.log)}, check=False)
    assert finished.returncode == 0
    assert (machine.project / ".venv").is_dir()


def test_a_user_gets_no_developers_tools_and_test_adds_them_to_the_same_environment(machine: Machine) -> None:
    machine.run("demo")
    assert machine.locks() == ["requirements.lock"]
    added = machine.run("test", "-k", "x")
    assert added.returncode == 0, added.stderr
    assert machine.locks() == ["requirements-dev.lock"]
    assert "developers' tools" in added.stderr
    machine.run("test", "-k", "x")
    machine.run("demo")
    assert machine.calls() == ["run", "run"]


def test_test_makes_both_parts(machine: Machine) -> None:
    machine.run("test", "-k", "x")
    assert machine.locks() == ["requirements.lock", "requirements-dev.lock"]


def test_a_changed_developers_lock_is_of_no_matter_to_a_user(machine: Machine) -> None:
    machine.run("test", "-k", "x")
    machine.calls()
    with (machine.project / "requirements-dev.lock").open("a") as file:
        file.write("# changed\n")
    machine.run("demo")
    assert machine.calls() == ["run"]
    machine.run("test", "-k", "x")
    assert machine.locks() == ["requirements-dev.lock"]


@pytest.mark.parametrize("name", ["pyproject.toml", "requirements.lock"])
def test_what_both_parts_were_made_from_is_installed_again_for_both(machine: Machine, name: str) -> None:
    machine.run("test", "-k", "x")
    machine.calls()
    with (machine.project / name).open("a") as file:
        file.write("# changed\n")
    machine.run("test", "-k", "x")
    assert machine.locks() == ["requirements.lock", "requirements-dev.lock"]


def test_developers_tools_broken_off_are_begun_afresh_and_the_user_goes_on(machine: Machine) -> None:
    machine.run("demo")
    no_network = machine.log.with_name("log.no-network")
    no_network.touch()
    assert machine.run("test", "-k", "x").returncode == 1
    machine.calls()
    assert machine.run("demo").returncode == 0
    assert machine.calls() == ["run"]
    no_network.unlink()
    assert machine.run("test", "-k", "x").returncode == 0
    assert machine.calls() == ["venv", "pip", "pip", "pip", "run"]


@pytest.mark.parametrize("name", ["pyproject.toml", "requirements.lock"])
def test_a_changed_lock_or_project_file_is_installed_again_into_the_same_environment(
    machine: Machine, name: str
) -> None:
    machine.run()
    machine.calls()
    with (machine.project / name).open("a") as file:
        file.write("# changed\n")
    machine.run()
    assert machine.calls() == ["pip", "pip", "run"]


def test_a_moved_project_is_set_up_again(machine: Machine) -> None:
    machine.run()
    machine.calls()
    moved = machine.project.rename(machine.project.with_name("moved"))
    assert Machine(machine.tools, moved, machine.log).run().returncode == 0
    assert machine.calls() == ["pip", "pip", "run"]


def test_a_broken_off_installation_is_begun_afresh(machine: Machine) -> None:
    no_network = machine.log.with_name("log.no-network")
    no_network.touch()
    broken = machine.run("demo")
    assert broken.returncode == 1
    assert "run the command again" in broken.stderr
    assert machine.calls() == ["venv", "pip"]
    no_network.unlink()
    assert machine.run("demo").returncode == 0
    assert machine.calls() == ["venv", "pip", "pip", "run"]


def test_test_runs_pytest_in_the_project(machine: Machine) -> None:
    machine.install("chromium", "#!/bin/sh\n")
    machine.install("chromedriver", "#!/bin/sh\n")
    finished = machine.run("test", "-k", "a or b")
    said = finished.stdout.splitlines()
    assert said[0] == f"in {machine.project}"
    assert said[-4:] == ["<-m>", "<pytest>", "<-k>", "<a or b>"]
    assert "browser" not in finished.stderr


def test_docs_adds_the_developers_tools_and_builds_the_site_from_any_folder(machine: Machine) -> None:
    finished = machine.run("docs")
    assert finished.returncode == 0, finished.stderr
    assert machine.locks() == ["requirements.lock", "requirements-dev.lock"]
    said = finished.stdout.splitlines()
    assert said[0] == f"in {machine.project}"
    assert said[-2:] == ["<docs>", "<build/docs>"]
    assert {"<sphinx>", "<--fail-on-warning>"} <= set(said)
    assert f"{machine.project}/build/docs/index.html" in finished.stderr


def test_docs_check_executes_the_blocks_and_builds_nothing(machine: Machine) -> None:
    said = machine.run("docs", "--check", "arms").stdout.splitlines()
    assert said[-4:] == ["<-m>", "<tests.documents>", "<--check>", "<arms>"]
    assert "<sphinx>" not in said


def test_all_tests_run_side_by_side_in_one_run(machine: Machine) -> None:
    said = machine.run("test").stdout.splitlines()
    assert said.count("<pytest>") == 1
    assert said[said.index("<-n>") + 1] == "<auto>"
    assert said[said.index("<--dist>") + 1] == "<loadfile>"
    assert not any("tests/" in word or "ignore" in word for word in said)


def test_what_streams_to_the_emulated_robot_runs_one_by_one_and_first() -> None:
    scheduling = Scheduling.__new__(Scheduling)  # its plugin need not be loaded
    places = {file.name: file.relative_to(ROOT).as_posix() for file in (ROOT / "tests").rglob("test_*.py")}
    streams = [f"{places[name]}::test_a" for name in STREAMING]
    assert set(SLEEPING) <= {file.name for file in (ROOT / "tests").rglob("test_*.py")}
    assert len({scheduling._split_scope(test) for test in streams}) == 1
    others = ["tests/hardware/test_emulator_wire.py::test_a", "tests/scenario/test_mounting_cell.py::test_a[b/c.py::d]"]
    assert [scheduling._split_scope(test) for test in others] == [test.partition("::")[0] for test in others]
    assert len({scheduling._split_scope(f"{path}::test_a") for path in DEMO}) == 1
    first, last = (
        SimpleNamespace(path=ROOT / test.partition("::")[0], nodeid=test) for test in (streams[-1], others[-1])
    )
    assert order(first) < order(last)  # type: ignore[arg-type]


def test_without_a_browser_the_tests_still_run_and_the_line_to_type_is_shown(machine: Machine) -> None:
    finished = machine.run("test")
    assert finished.returncode == 0
    assert "sudo apt-get install -y chrom" in finished.stderr


def test_without_a_supported_python_the_line_to_type_is_shown(machine: Machine) -> None:
    (machine.tools / "python3.11").unlink()
    machine.install("python3", python("3.10"))
    finished = machine.run("demo")
    assert finished.returncode == 1
    assert "Python 3.11, 3.12 or 3.13 was not found" in finished.stderr
    assert "Debian 12, Debian 13 or Ubuntu 24.04" in finished.stderr
    assert finished.stderr.strip().endswith("sudo apt-get install -y python3 python3-venv")
    assert machine.calls() == []
    assert not (machine.project / ".venv").exists()


def test_root_installs_the_distributions_python_where_there_is_none(machine: Machine) -> None:
    (machine.tools / "python3.11").unlink()
    (machine.tools / "hidden").write_text(python("3.13"))
    machine.install("id", "#!/bin/sh\necho 0\n")
    machine.install("apt-cache", "#!/bin/sh\n")
    hidden, there = machine.tools / "hidden", machine.tools / "python3"
    machine.install("apt-get", f'#!/bin/sh\necho "apt-get $*" >>"$LOG"\ncp {hidden} {there}; chmod +x {there}\n')
    finished = machine.run("demo")
    assert finished.returncode == 0, finished.stderr
    assert machine.lines()[0] == "apt-get -q install -y --no-install-recommends python3 python3-venv"


def test_the_newest_python_with_which_everything_works_is_taken(machine: Machine) -> None:
    machine.install("python3.13", python("3.13"))
    later = machine.tools.parent / "later"
    later.mkdir()
    Machine(later, machine.project, machine.log).install("python3", python("3.12"))
    run = [str(machine.project / "tools" / "run")]
    environment = {"PATH": f"{machine.tools}:{later}", "LOG": str(machine.log)}
    finished = subprocess.run(run, env=environment, check=True, capture_output=True, text=True)
    assert machine.lines()[0].startswith("venv 3.12 ")
    assert "robot" not in finished.stderr


def test_an_environment_stays_while_its_python_is_supported(machine: Machine) -> None:
    machine.run("demo")
    machine.install("python3.12", python("3.12"))
    with (machine.project / "requirements.lock").open("a") as file:
        file.write("# changed\n")
    machine.calls()
    machine.run("demo")
    assert machine.calls() == ["pip", "pip", "run"]
    (machine.project / ".venv" / "bin" / "python").write_text(python("3.10"))
    with (machine.project / "requirements.lock").open("a") as file:
        file.write("# changed again\n")
    machine.run("demo")
    assert machine.lines()[0].startswith("venv 3.12 ")


def test_the_venv_package_is_that_of_the_python_found(machine: Machine) -> None:
    machine.install("python3.12", python("3.12"))
    machine.log.with_name("log.no-ensurepip").touch()
    finished = machine.run("demo")
    assert finished.returncode == 1
    assert finished.stderr.strip().endswith("sudo apt-get install -y python3.12-venv")


def test_a_python_that_refuses_to_run_does_not_hide_one_that_works(machine: Machine) -> None:
    shims = machine.tools.parent / "shims"
    shims.mkdir()
    before = Machine(shims, machine.project, machine.log)
    for name in ("python3.12", "python3.11"):
        before.install(name, "#!/bin/sh\nexit 127\n")
    both = f"{shims}:{machine.tools}"
    run = [str(machine.project / "tools" / "run")]
    assert subprocess.run(run, env={"PATH": both, "LOG": str(machine.log)}, check=False).returncode == 0


def test_of_one_version_the_distributions_is_taken_and_another_where_it_has_no_venv(machine: Machine) -> None:
    distribution = machine.tools.parent / "usr" / "bin"
    distribution.mkdir(parents=True)
    its = Machine(distribution, machine.project, machine.log)
    run = [str(machine.project / "tools" / "run")]
    environment = {"PATH": f"{machine.tools}:{distribution}", "LOG": str(machine.log)}
    for of_it, taken in (("", distribution / "python3"), ("; exit 1", machine.tools / "python3.11")):
        its.install("python3", python("3.11").replace('[ ! -e "$LOG.no-ensurepip" ]', f"true{of_it}"))
        finished = subprocess.run(run, env=environment, check=True, capture_output=True, text=True)
        assert f" with {taken}" in finished.stderr
        shutil.rmtree(machine.project / ".venv")
    machine.install("python3.12", python("3.12"))
    finished = subprocess.run(run, env=environment, check=True, capture_output=True, text=True)
    assert f" with {machine.tools / 'python3.12'}" in finished.stderr, "a newer one goes before it"


def test_missing_libraries_are_named_with_the_line_to_type(machine: Machine) -> None:
    machine.install("ldconfig", "#!/bin/sh\n")
    finished = machine.run("demo")
    assert finished.returncode == 1
    assert finished.stderr.strip().endswith(f"sudo apt-get install -y {' '.join(LIBRARIES.values())}")
    assert machine.calls() == []


def test_root_installs_missing_libraries(machine: Machine) -> None:
    machine.install("ldconfig", listing(*(name for name in LIBRARIES if "GL" not in name)))
    machine.install("id", "#!/bin/sh\necho 0\n")
    machine.install("apt-cache", "#!/bin/sh\nexit 1\n")
    machine.install("apt-get", '#!/bin/sh\necho "apt-get $DEBIAN_FRONTEND $*" >>"$LOG"\n')
    assert machine.run("demo").returncode == 0
    lines = machine.log.read_text().splitlines()
    assert lines[:2] == [
        "apt-get  -q update",
        "apt-get noninteractive -q install -y --no-install-recommends libgl1 libegl1",
    ]


def test_two_runs_at_once_make_one_environment(machine: Machine) -> None:
    slow = python("3.11").replace('echo "pip $*" >>"$LOG";', 'echo "pip $*" >>"$LOG"; sleep 0.5;')
    machine.install("python3.11", slow)
    sleep = shutil.which("sleep")
    assert sleep is not None
    (machine.tools / "sleep").symlink_to(sleep)
    environment = {"PATH": str(machine.tools), "LOG": str(machine.log)}
    runs = [subprocess.Popen([str(machine.project / "tools" / "run")], env=environment) for _ in range(2)]
    assert [run.wait(timeout=60) for run in runs] == [0, 0]
    assert sorted(machine.calls()) == ["pip", "pip", "run", "run", "venv"]
