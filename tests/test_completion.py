"""What a shell completes, asked of the shells themselves."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from dropo_torch.commands.cli import COMMANDS, SHELLS, main
from dropo_torch.config import KEYS

#: Asks bash, as its Tab key does, what it would put after the words given.
ASK = """
source "$1"; shift
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMP_LINE="$*" COMP_POINT=${#COMP_LINE}
_shtab_dropo
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture
def script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """What bash reads."""
    assert main(["--completion", "bash"]) == 0
    path = tmp_path / "dropo.bash"
    path.write_text(capsys.readouterr().out)
    return path


def completed(script: Path, words: str, folder: Path | None = None) -> set[str]:
    """What bash completes the last word to."""
    ask = ["bash", "--norc", "-c", ASK, "bash", str(script), *words.split(" ")]
    found = subprocess.run(ask, capture_output=True, text=True, check=True, cwd=folder)
    return set(found.stdout.split())


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_commands_options_keys_and_values(script: Path) -> None:
    assert completed(script, "dropo ") >= set(COMMANDS)
    assert completed(script, "dropo g") == {"gap"}
    assert completed(script, "dropo fit robot.yaml --") >= {"--out", "--resume", "--log", *(f"--{key}" for key in KEYS)}
    assert "--epsilon" not in completed(script, "dropo reproduce --")
    assert completed(script, "dropo gap robot.yaml --time") == {"--time-limit"}
    assert completed(script, "dropo fit robot.yaml --backend ") == {"mujoco", "warp", "gymnasium"}
    assert completed(script, "dropo train robot.yaml --algorithm ") == {"ppo", "sac"}
    assert completed(script, "dropo reproduce h") == {"hopper"}


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_files_and_folders(script: Path, tmp_path: Path) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robot.yaml").touch()
    assert completed(script, "dropo fit rob", tmp_path) == {"robots", "robot.yaml"}
    assert completed(script, "dropo init rob", tmp_path) == {"robots", "robot.yaml"}
    assert completed(script, "dropo fit robot.yaml --out rob", tmp_path) == {"robots"}


@pytest.mark.parametrize("shell", SHELLS)
def test_shells_understand_what_they_read(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"--completion={shell}"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell}")
    path = tmp_path / "script"
    path.write_text(text)
    subprocess.run([shell, "-n", path], check=True)


@pytest.mark.parametrize("given", ["--completion", "--completion=tcsh"])
def test_other_shells_are_refused_in_one_line(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([given]) == 2
    error = capsys.readouterr().err
    assert "--completion" in error
    assert error.count("\n") == 1
