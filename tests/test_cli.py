import pytest

from meshanim.cli import VERBS, main


def test_help_names_every_verb(capsys):
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert all(verb in printed for verb in VERBS)


def test_unknown_verb_is_one_line_and_exit_2(capsys):
    assert main(["sing"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "sing" in error
    assert "doctor" in error


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_with_an_example(verb, capsys):
    from importlib import import_module

    commands = import_module(f"meshanim.cli.{verb}").COMMANDS
    for words in (
        [[verb, name, "--help"] for name in commands] if isinstance(commands, dict) else [[verb, "--help"]]
    ):
        assert main(words) == 0
        assert f"meshanim {' '.join(words[:-1])}" in " ".join(capsys.readouterr().out.split())


def test_doctor_reports_the_kernels(capsys):
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    assert "native" in printed
    assert "torch" in printed


def test_runs_as_a_module():
    import subprocess
    import sys

    done = subprocess.run([sys.executable, "-m", "meshanim", "--version"], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.strip()[0].isdigit()
