"""Everything that can be set from outside: environment `UNGLARE_*`, a file `.env`, or the command line.

Read by `main` and `cli` only, which pass it on as values.
"""

import os
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict, SettingsError

from backend.domain.errors import StartupError

SHORTEST_TOKEN = 8
PREFIX = "UNGLARE_"


def default_data_folder() -> Path:
    """Return where data lie if nothing else is said: `$XDG_DATA_HOME/unglare` or `~/.local/share/unglare`."""
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "unglare"


class Settings(BaseSettings):
    """All settings. Each one is an environment variable: `UNGLARE_` and its name in capitals."""

    model_config = SettingsConfigDict(
        env_prefix=PREFIX,
        env_file=".env",
        env_ignore_empty=True,
        extra="ignore",
        frozen=True,
        use_attribute_docstrings=True,
    )

    data_folder: Path = Field(default_factory=default_data_folder)
    """Database, artifacts, caches, uploads."""
    database_url: str | None = None
    """`postgresql://user:password@host/name`; none: SQLite in the data folder."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for every network of the machine."""
    port: int = Field(8000, ge=0, le=65535)
    """0: any free one."""
    token: SecretStr | None = None
    """Operators log in with it; none: made anew at each start and printed."""
    viewer_token: SecretStr | None = None
    """Viewers log in with it; none: no viewers."""
    session_hours: float = Field(12.0, gt=0, le=24 * 365)
    """After that a login ends."""
    trusted_proxies: str = ""
    """Addresses of a TLS proxy in front, separated by commas: its X-Forwarded-* headers are believed. It has to
    pass on Host and Origin as they came."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    rig: str = "simulated"
    """This station's own rig, offered first: its name or `package.module:factory`."""
    rig_options: dict[str, Any] = {}
    """Its options where a scan names no others, as JSON."""
    upload_limit_mb: int = Field(8192, gt=0)
    """Largest capture that can be uploaded, packed and unpacked [MiB]."""
    threads: int = Field(16, ge=2, le=256)
    """So many requests are worked on at once."""
    station: bool = True
    """False: only the API, no browser interface."""

    @field_validator("data_folder")
    @classmethod
    def _absolute(cls, folder: Path) -> Path:
        return folder.expanduser().absolute()

    @field_validator("token", "viewer_token")
    @classmethod
    def _long_enough(cls, token: SecretStr | None) -> SecretStr | None:
        if token is not None and len(token.get_secret_value()) < SHORTEST_TOKEN:
            raise ValueError(f"it has to have {SHORTEST_TOKEN} characters at least")
        return token

    @model_validator(mode="after")
    def _different_tokens(self) -> "Settings":
        if self.token is not None and self.token == self.viewer_token:
            raise ValueError("the operators' and the viewers' token have to be different")
        return self

    @property
    def database(self) -> str:
        """Address of the database."""
        return self.database_url or f"sqlite:///{self.data_folder / 'unglare.db'}"

    @property
    def artifact_folder(self) -> Path:
        """Folder of the local artifact store."""
        return self.data_folder / "artifacts"

    @property
    def rig_folder(self) -> Path:
        """Folder of the station's rig files."""
        return self.data_folder / "rigs"


def load_settings(**given: Any) -> Settings:
    """Read the settings; what is given here (from a command line) counts more than the environment.

    Raises
    ------
    StartupError
        With one sentence that names the setting and what is wrong with it.
    """
    chosen = {name: value for name, value in given.items() if value is not None}
    try:
        return Settings(**chosen)
    except ValidationError as error:
        finding = error.errors(include_url=False, include_input=False)[0]
        name = PREFIX + "_".join(str(part) for part in finding["loc"][:1]).upper()
        reason = finding["msg"].removeprefix("Value error, ")
        raise StartupError(f"The setting {name.rstrip('_')} can't be used: {reason}.") from error
    except SettingsError as error:
        raise StartupError(f"A setting isn't the JSON that it has to be: {error}.") from error
