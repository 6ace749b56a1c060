"""What can be set from outside, and what is said when it can't."""

from pathlib import Path

import pytest

from backend.domain.errors import StartupError
from backend.settings import load_settings


@pytest.fixture(autouse=True)
def _clean_surroundings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No UNGLARE_* variables and no .env of whoever runs the tests."""
    import os

    for name in [n for n in os.environ if n.startswith("UNGLARE_")]:
        monkeypatch.delenv(name)
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.chdir(tmp_path)


def test_without_anything_set_it_is_a_station_of_ones_own() -> None:
    settings = load_settings()

    assert (settings.host, settings.port) == ("127.0.0.1", 8000)
    assert settings.token is None
    assert settings.data_folder == Path.home() / ".local" / "share" / "unglare"
    assert settings.database == f"sqlite:///{settings.data_folder}/unglare.db"


def test_the_environment_counts_and_the_command_line_counts_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("UNGLARE_PORT", "8100")
    monkeypatch.setenv("UNGLARE_HOST", "0.0.0.0")
    monkeypatch.setenv("UNGLARE_TOKEN", "")

    settings = load_settings(port=8200, host=None)

    assert (settings.host, settings.port) == ("0.0.0.0", 8200)
    assert settings.token is None


def test_data_follow_the_desktop_standard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", "/srv")

    assert load_settings().data_folder == Path("/srv/unglare")


def test_a_relative_folder_is_the_one_where_it_was_said(tmp_path: Path) -> None:
    assert load_settings(data_folder="here").data_folder == tmp_path / "here"


@pytest.mark.parametrize(
    ("variables", "sentence"),
    [
        ({"PORT": "eight"}, "UNGLARE_PORT can't be used: Input should be a valid integer"),
        ({"PORT": "70000"}, "UNGLARE_PORT can't be used: .* less than or equal to 65535"),
        ({"TOKEN": "short"}, "UNGLARE_TOKEN can't be used: it has to have 8 characters at least"),
        ({"TOKEN": "the same one", "VIEWER_TOKEN": "the same one"}, "have to be different"),
        ({"RIG_OPTIONS": "{bad"}, "isn't the JSON that it has to be"),
        ({"LOG_LEVEL": "loud"}, "UNGLARE_LOG_LEVEL can't be used"),
    ],
)
def test_a_setting_that_cant_be_used_is_named(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], sentence: str
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(f"UNGLARE_{name}", value)

    with pytest.raises(StartupError, match=sentence):
        load_settings()


def test_a_token_doesnt_show_when_settings_are_printed() -> None:
    assert "very secret" not in repr(load_settings(token="very secret"))
