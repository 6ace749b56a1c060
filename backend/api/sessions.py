"""Who is there: tokens, sessions that expire, and a limit on wrong guesses.

Everything here but the count lives on the event loop's thread; nothing takes a lock.
"""

import asyncio
import contextlib
import enum
import hashlib
import hmac
import ipaddress
import logging
import math
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from backend.api.errors import NotLoggedInError, TooManyAttemptsError
from backend.api.page_tickets import PageTickets

_log = logging.getLogger(__name__)

LONGEST_NAME = 60
STATION_PREFIX = "station."
"""Marks tokens of sessions, so that a stale one is never mistaken for a wrong guess of a master token."""


class Role(enum.StrEnum):
    """What a caller may do."""

    OPERATOR = "operator"
    VIEWER = "viewer"


@dataclass(frozen=True)
class Tokens:
    """The tokens that open the door."""

    operator: str
    viewer: str | None = None
    """None: nobody can log in as a viewer."""

    def role_of(self, token: str) -> Role | None:
        """Return the role that a token stands for; the time it takes tells nothing about the tokens."""
        operator = _equal(token, self.operator)
        viewer = _equal(token, self.viewer or "") and self.viewer is not None
        if operator:
            return Role.OPERATOR
        return Role.VIEWER if viewer else None


@dataclass(eq=False)
class Session:
    """One login of one browser, until it expires or logs out."""

    user: str
    role: Role
    expires_s: float
    """When it ends, on the clock of `Sessions`."""
    station_token: str = field(
        default_factory=lambda: STATION_PREFIX + secrets.token_urlsafe(32), repr=False
    )
    """With it the station calls the API for this session, and only as long as the session lasts."""
    ended: asyncio.Event = field(default_factory=asyncio.Event, repr=False)
    """Set when the session ends, so that its sockets and streams close."""


@dataclass(frozen=True)
class Caller:
    """Who sends a request."""

    user: str
    role: Role
    session: Session | None = None
    """None for a caller that shows a master token with each request."""


class Attempts:
    """Counts wrong tokens per address: a burst is free, then one more each `recovery_s`."""

    def __init__(self, *, burst: int = 8, recovery_s: float = 15.0, capacity: int = 10_000) -> None:
        self._burst = burst
        self._recovery_s = recovery_s
        self._capacity = capacity
        self._free_at_s: dict[str, float] = {}
        """When the address will have paid for all its wrong guesses."""

    def check(self, address: str, now_s: float) -> None:
        """Refuse an address that has used up its guesses, a right one included."""
        debt_s = self._free_at_s.get(_network(address), 0.0) - now_s
        wait_s = debt_s - (self._burst - 1) * self._recovery_s
        if wait_s > 0:
            raise TooManyAttemptsError(
                f"Too many wrong tokens came from {address}; try again in {math.ceil(wait_s)} s.",
                wait_s=math.ceil(wait_s),
            )

    def failed(self, address: str, now_s: float) -> None:
        """Note a wrong guess."""
        network = _network(address)
        free_at_s = max(self._free_at_s.pop(network, now_s), now_s) + self._recovery_s
        if len(self._free_at_s) >= self._capacity:
            self._free_at_s.pop(
                next(iter(self._free_at_s))
            )  # the address that was wrong longest ago
        self._free_at_s[network] = free_at_s


class Sessions:
    """Everybody who is logged in.

    Parameters
    ----------
    tokens
        The master tokens.
    lifetime_s
        A session ends so long after its login [s], used or not: a station's page never stops asking.
    capacity
        With more sessions than that, the oldest is ended.
    clock
        Seconds that never go back.
    """

    def __init__(
        self,
        tokens: Tokens,
        *,
        lifetime_s: float = 12 * 3600.0,
        capacity: int = 500,
        clock: Callable[[], float] = time.monotonic,
        attempts: Attempts | None = None,
    ) -> None:
        self._tokens = tokens
        self._lifetime_s = lifetime_s
        self._capacity = capacity
        self._clock = clock
        self._attempts = attempts or Attempts()
        self._by_cookie: dict[bytes, Session] = {}
        self._by_station_token: dict[bytes, Session] = {}
        self.closed = asyncio.Event()
        """Set when the server stops: streams of callers without a session end then."""
        self.tickets = PageTickets(tokens.operator)
        """What outlives a session: a projector window's right to be the projector."""

    @property
    def lifetime_s(self) -> float:
        """How long a session lasts [s]."""
        return self._lifetime_s

    def __len__(self) -> int:
        """Count the sessions that haven't expired."""
        now_s = self._clock()
        return sum(session.expires_s > now_s for session in list(self._by_cookie.values()))

    def login(self, name: str, token: str, address: str) -> tuple[str, Session]:
        """Open a session for a right token.

        Parameters
        ----------
        name
            What the user calls himself; empty: the name of the role.
        address
            Where the request came from; wrong guesses are counted under it.

        Returns
        -------
        cookie
            The secret that goes into the browser's cookie; only its hash stays here.
        session
            The new session.

        Raises
        ------
        NotLoggedInError
            If the token is wrong.
        TooManyAttemptsError
            If too many wrong ones came from this address.
        """
        role = self._role(token, address)
        self._drop_expired()
        if len(self._by_cookie) >= self._capacity:
            self.end(next(iter(self._by_cookie.values())))
        cookie = secrets.token_urlsafe(32)
        session = Session(tidy_name(name) or role.value, role, self._clock() + self._lifetime_s)
        self._by_cookie[_digest(cookie)] = session
        self._by_station_token[_digest(session.station_token)] = session
        _log.info("%s logged in as %s from %s.", session.user, role.value, address)
        return cookie, session

    def of_cookie(self, cookie: str) -> Session | None:
        """Return the session of a cookie, None if there is none or it has ended."""
        return self._valid(self._by_cookie.get(_digest(cookie)))

    def of_token(self, token: str, name: str, address: str) -> Caller:
        """Return who shows this token: a session's station token, or a master token with a name of choice."""
        if token.startswith(STATION_PREFIX):
            session = self._valid(self._by_station_token.get(_digest(token)))
            if session is None:
                raise NotLoggedInError("The session of this token has ended; log in again.")
            return Caller(session.user, session.role, session)
        role = self._role(token, address)
        return Caller(tidy_name(name) or role.value, role)

    def end(self, session: Session) -> None:
        """End a session: its cookie and its station token stop working, its sockets close."""
        session.ended.set()
        self._by_cookie = {k: s for k, s in self._by_cookie.items() if s is not session}
        self._by_station_token.pop(_digest(session.station_token), None)

    def end_all(self) -> None:
        """End every session, because the server stops."""
        self.closed.set()
        for session in list(self._by_cookie.values()):
            self.end(session)

    async def wait_for_end(self, session: Session | None) -> None:
        """Return when the session has ended, by logout or by the clock; without one, when the server stops."""
        if session is None:
            await self.closed.wait()
            return
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(session.expires_s - self._clock(), 0.0)):
                await session.ended.wait()
        self.end(session)

    def _role(self, token: str, address: str) -> Role:
        self._attempts.check(address, self._clock())
        role = self._tokens.role_of(token)
        if role is None:
            self._attempts.failed(address, self._clock())
            _log.warning("A wrong token came from %s.", address)
            raise NotLoggedInError(
                "The token is wrong; the right one stands in the terminal where the server was started."
            )
        return role

    def _valid(self, session: Session | None) -> Session | None:
        if session is not None and session.expires_s <= self._clock():
            self.end(session)
            return None
        return session

    def _drop_expired(self) -> None:
        for session in list(self._by_cookie.values()):
            self._valid(session)


def tidy_name(name: str) -> str:
    r"""Make a user's name fit for a line of the audit trail: printable, single spaces, not too long.

    Examples
    --------
    >>> tidy_name("  Ada\n Lovelace ")
    'Ada Lovelace'
    """
    printable = "".join(c if c.isprintable() else " " for c in name)
    return " ".join(printable.split())[:LONGEST_NAME].strip()


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()


def _equal(left: str, right: str) -> bool:
    # Hashes first: compare_digest gives away the length of what it compares.
    return hmac.compare_digest(_digest(left), _digest(right))


def _network(address: str) -> str:
    """Return the address, of an IPv6 address its /64: one host owns all of it."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network((ip, 64), strict=False)) if ip.version == 6 else address
