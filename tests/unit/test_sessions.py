"""Who may come in, for how long, and what happens to those who guess."""

import asyncio
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.api.errors import NotLoggedInError, TooManyAttemptsError
from backend.api.sessions import (
    LONGEST_NAME,
    STATION_PREFIX,
    Attempts,
    Role,
    Sessions,
    Tokens,
    tidy_name,
)

OPERATOR, VIEWER = "the operators' token", "the viewers' token"
HERE, ELSEWHERE = "192.0.2.7", "192.0.2.8"


@dataclass
class Clock:
    now_s: float = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def sessions(clock: Clock) -> Sessions:
    return Sessions(
        Tokens(OPERATOR, VIEWER),
        lifetime_s=60.0,
        capacity=3,
        clock=clock,
        attempts=Attempts(burst=3, recovery_s=10.0),
    )


@pytest.mark.parametrize(
    ("token", "role"),
    [
        (OPERATOR, Role.OPERATOR),
        (VIEWER, Role.VIEWER),
        ("", None),
        (OPERATOR + "x", None),
        (OPERATOR[:-1], None),
        (OPERATOR.upper(), None),
        ("\udcff", None),
    ],
)
def test_a_token_stands_for_its_role_and_nothing_else_does(token: str, role: Role | None) -> None:
    assert Tokens(OPERATOR, VIEWER).role_of(token) is role


def test_without_a_viewers_token_nobody_is_a_viewer() -> None:
    assert Tokens(OPERATOR).role_of("") is None


def test_a_login_is_found_by_its_cookie_and_by_its_station_token(sessions: Sessions) -> None:
    cookie, session = sessions.login("Ada", VIEWER, HERE)

    caller = sessions.of_token(session.station_token, "somebody else", HERE)

    assert sessions.of_cookie(cookie) is session
    assert (caller.user, caller.role, caller.session) == ("Ada", Role.VIEWER, session)


def test_two_logins_have_nothing_in_common(sessions: Sessions) -> None:
    (cookie_1, one), (cookie_2, two) = (sessions.login("Ada", OPERATOR, HERE) for _ in range(2))

    assert cookie_1 != cookie_2
    assert one.station_token != two.station_token


def test_a_master_token_takes_the_name_that_is_shown_with_it(sessions: Sessions) -> None:
    assert sessions.of_token(OPERATOR, " Grace ", HERE).user == "Grace"
    assert sessions.of_token(VIEWER, "", HERE).user == "viewer"


def test_logout_ends_cookie_station_token_and_whoever_waits(sessions: Sessions) -> None:
    cookie, session = sessions.login("Ada", OPERATOR, HERE)

    async def wait_and_end() -> None:
        waiting = asyncio.create_task(sessions.wait_for_end(session))
        await asyncio.sleep(0)
        sessions.end(session)
        await asyncio.wait_for(waiting, 5)

    asyncio.run(wait_and_end())

    assert sessions.of_cookie(cookie) is None
    with pytest.raises(NotLoggedInError, match="session of this token has ended"):
        sessions.of_token(session.station_token, "", HERE)


def test_a_session_lasts_exactly_its_lifetime_however_much_it_is_used(
    sessions: Sessions, clock: Clock
) -> None:
    cookie, session = sessions.login("Ada", OPERATOR, HERE)

    clock.now_s += 59.9
    assert sessions.of_cookie(cookie) is session
    assert len(sessions) == 1
    clock.now_s += 0.1
    assert len(sessions) == 0
    assert sessions.of_cookie(cookie) is None
    assert session.ended.is_set()


def test_waiting_for_an_expired_session_returns_at_once(sessions: Sessions, clock: Clock) -> None:
    _, session = sessions.login("Ada", OPERATOR, HERE)
    clock.now_s += 61

    asyncio.run(asyncio.wait_for(sessions.wait_for_end(session), 5))

    assert session.ended.is_set()


def test_the_oldest_session_makes_room(sessions: Sessions) -> None:
    logins = [sessions.login(name, OPERATOR, HERE) for name in ("a", "b", "c", "d")]

    found = [sessions.of_cookie(cookie) is session for cookie, session in logins]

    assert found == [False, True, True, True]


def test_ending_all_leaves_nobody(sessions: Sessions) -> None:
    ended = [sessions.login(name, OPERATOR, HERE)[1].ended for name in ("a", "b")]

    sessions.end_all()

    assert len(sessions) == 0
    assert all(event.is_set() for event in ended)


def guess(sessions: Sessions, address: str, times: int) -> None:
    for _ in range(times):
        with pytest.raises(NotLoggedInError):
            sessions.login("Eve", "a guess", address)


def test_after_its_free_guesses_an_address_waits_even_with_the_right_token(
    sessions: Sessions, clock: Clock
) -> None:
    guess(sessions, HERE, 3)

    with pytest.raises(TooManyAttemptsError, match=r"192\.0\.2\.7; try again in 10 s\.") as refused:
        sessions.login("Eve", OPERATOR, HERE)

    assert refused.value.wait_s == 10
    sessions.login("Ada", OPERATOR, ELSEWHERE)
    clock.now_s += 10
    sessions.login("Ada", OPERATOR, HERE)


def test_each_further_guess_costs_its_time(sessions: Sessions, clock: Clock) -> None:
    guess(sessions, HERE, 3)
    clock.now_s += 10
    guess(sessions, HERE, 1)

    with pytest.raises(TooManyAttemptsError):
        sessions.login("Eve", "a guess", HERE)


def test_a_dead_station_token_is_no_guess(sessions: Sessions) -> None:
    for _ in range(10):
        with pytest.raises(NotLoggedInError):
            sessions.of_token(STATION_PREFIX + "dead", "", HERE)

    sessions.login("Ada", OPERATOR, HERE)


def test_who_is_logged_in_stays_so_while_others_guess_from_there(sessions: Sessions) -> None:
    cookie, session = sessions.login("Ada", OPERATOR, HERE)
    guess(sessions, HERE, 3)

    assert sessions.of_cookie(cookie) is session
    assert sessions.of_token(session.station_token, "", HERE).user == "Ada"


def test_addresses_of_one_ipv6_network_share_their_guesses() -> None:
    attempts = Attempts(burst=1, recovery_s=10.0)

    attempts.failed("2001:db8::1", 0.0)

    with pytest.raises(TooManyAttemptsError):
        attempts.check("2001:db8::2", 0.0)
    attempts.check("2001:db8:0:1::1", 0.0)


def test_only_so_many_addresses_are_remembered() -> None:
    attempts = Attempts(burst=1, recovery_s=10.0, capacity=2)

    for address in ("192.0.2.1", "192.0.2.2", "192.0.2.3"):
        attempts.failed(address, 0.0)

    attempts.check("192.0.2.1", 0.0)
    with pytest.raises(TooManyAttemptsError):
        attempts.check("192.0.2.3", 0.0)


@given(st.text(st.characters(), max_size=200))
def test_a_name_is_one_short_printable_line(name: str) -> None:
    tidy = tidy_name(name)

    assert tidy.isprintable()
    assert len(tidy) <= LONGEST_NAME
    assert tidy == tidy.strip()
    assert tidy_name(tidy) == tidy
