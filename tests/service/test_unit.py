"""The unit: systemd's own tools find nothing wrong with it, and installing it puts it where they look."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from aemd.config import load_config
from aemd.errors import RecordingError, UsageError
from aemd.install import install, plan_system, plan_user
from aemd.live.runtime import announced

CONFIG = Path(__file__).parents[2] / "config"
analyze = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")


def said_of(*words: str) -> str:
    """Return all that systemd-analyze prints: `verify` exits with 0 even where it complains of unknown keys."""
    ran = subprocess.run(["systemd-analyze", *words], capture_output=True, text=True, check=False)
    return ran.stdout + ran.stderr + (f"exit code {ran.returncode}" if ran.returncode else "")


@analyze
def test_the_unit_verifies_without_a_word() -> None:
    assert said_of("verify", str(CONFIG / "aemd.service")) == ""


@analyze
def test_a_misspelt_key_would_be_noticed(tmp_path: Path) -> None:
    unit = tmp_path / "aemd.service"
    unit.write_text((CONFIG / "aemd.service").read_text().replace("ProtectHome", "ProtectHone"))

    assert "ProtectHone" in said_of("verify", str(unit))


@analyze
def test_the_unit_is_exposed_to_at_most_1_7() -> None:
    told = said_of("security", "--offline=true", "--no-pager", str(CONFIG / "aemd.service"))
    level = re.search(r"Overall exposure level for aemd.service: ([0-9.]+)", told)

    assert level is not None, told
    assert float(level[1]) <= 1.7


@analyze
@pytest.mark.parametrize("folder", ["plain", "with a space", "100%"])
def test_an_installed_unit_starts_this_very_aemd(folder: str, tmp_path: Path) -> None:
    command = tmp_path / folder / "aemd"
    command.parent.mkdir()
    command.write_text("#!/bin/sh\n")
    command.chmod(0o755)
    plan = plan_user({"HOME": str(tmp_path)}, command)

    install(plan, user=True, dry_run=False)

    unit = tmp_path / ".config/systemd/user/aemd.service"
    assert said_of("verify", str(unit)) == ""  # a command that is not there would be told of
    assert "ProtectSystem" not in unit.read_text()  # which takes rights that an account does not have


def test_a_system_installation_holds_all_that_the_unit_names(tmp_path: Path) -> None:
    summary = install(plan_system(tmp_path, Path("/opt/aemd/bin/aemd")), user=False, dry_run=False)

    unit = (tmp_path / "etc/systemd/system/aemd.service").read_text()
    assert "ExecStart=/opt/aemd/bin/aemd acquire /etc/aemd/aemd.toml --out /var/lib/aemd --live\n" in unit
    users = (tmp_path / "etc/sysusers.d/aemd.conf").read_text()
    group = re.search(r"^SupplementaryGroups=(\S+)$", unit, re.MULTILINE)
    assert group is not None
    assert re.search(rf"^g {group[1]} ", users, re.MULTILINE)
    assert re.search(r"^u aemd ", users, re.MULTILINE)
    assert f'GROUP="{group[1]}"' in (tmp_path / "etc/udev/rules.d/60-aemd.rules").read_text()
    assert load_config(tmp_path / "etc/aemd/aemd.toml").driver == "agilent34410"
    assert summary.next[-1] == "systemctl enable --now aemd"


def test_a_config_that_is_there_is_the_owners(tmp_path: Path) -> None:
    plan = plan_system(tmp_path, Path("/opt/aemd/bin/aemd"))
    install(plan, user=False, dry_run=False)
    mine = tmp_path / "etc/aemd/aemd.toml"
    mine.write_text("mine")

    summary = install(plan, user=False, dry_run=False)

    assert mine.read_text() == "mine"
    assert summary.kept == (str(mine),)


def test_a_dry_run_writes_nothing(tmp_path: Path) -> None:
    summary = install(plan_system(tmp_path, Path("/opt/aemd/bin/aemd")), user=False, dry_run=True)

    assert len(summary.written) == 4
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("hidden", ["/home/anna/.venv/bin/aemd", "/root/aemd", "/tmp/venv/bin/aemd"])
def test_an_installation_that_the_unit_could_not_see_is_refused(hidden: str) -> None:
    with pytest.raises(UsageError, match=r"sees nothing below .*; install aemd elsewhere"):
        plan_system(command=Path(hidden))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_who_may_not_write_is_told_the_way_out(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(RecordingError, match="cannot be written: permission denied; use sudo"):
        install(plan_system(tmp_path, Path("/opt/aemd/bin/aemd")), user=False, dry_run=False)


def test_a_file_in_the_way_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "etc").write_text("")

    with pytest.raises(RecordingError, match=r"cannot be written: .*use sudo"):
        install(plan_system(tmp_path, Path("/opt/aemd/bin/aemd")), user=False, dry_run=False)


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="systemd-sysusers is not installed")
def test_the_users_file_is_understood(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    command = ["systemd-sysusers", f"--root={tmp_path}", str(CONFIG / "aemd.sysusers")]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)

    assert ran.returncode == 0, ran.stderr
    assert re.search(r"^aemd:x:\d+:\d+:aemd acquisition:/var/lib/aemd:", (tmp_path / "etc/passwd").read_text())
    assert re.search(r"^aemd-dev:x:\d+:aemd$", (tmp_path / "etc/group").read_text(), re.MULTILINE)


def test_everybodys_status_finds_the_services_page(tmp_path: Path) -> None:
    """systemd makes the folder; one account writes into it, and the others read."""
    unit = (CONFIG / "aemd.service").read_text()
    environment = {"RUNTIME_DIRECTORY": str(tmp_path)}
    modes = []
    for url in ("http://127.0.0.1:8410/", "http://127.0.0.1:8410/?token=t"):
        with announced(url, "34410A", environment) as path:
            assert path is not None
            modes.append(path.stat().st_mode & 0o777)

    assert "\nRuntimeDirectory=aemd\n" in unit  # /run/aemd, where `find_running` looks
    assert " --live\n" in unit
    assert modes == [0o644, 0o640]
