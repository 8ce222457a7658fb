"""The command that simulates a mission."""

from uw_dslam_ros2.cli import simulate


def test_progress_is_a_bar_on_a_terminal_only(tmp_path, capsys):
    arguments = ["--out", str(tmp_path / "m"), "--vehicles", "1", "--duration", "6"]
    assert simulate.main([*arguments, "--processes", "1", "--beams", "64"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert 1 <= len(lines) <= 10
    assert all(line.startswith("simulate: ") and line.endswith(" pings") for line in lines)


def test_command_line(tmp_path, capsys):
    arguments = ["--out", str(tmp_path / "m"), "--vehicles", "1", "--duration", "3", "--quiet"]
    assert simulate.main([*arguments, "--processes", "1", "--beams", "64"]) == 0
    assert "1 bags" in capsys.readouterr().out
    assert simulate.main(arguments) == 2
    assert "holds a mission already" in capsys.readouterr().err
    assert simulate.main([*arguments, "--duration", "-1"]) == 2
    assert "duration_s is -1.0, expected 2.0 to 7200.0" in capsys.readouterr().err
