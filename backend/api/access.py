"""Which caller a request comes from, and whether it may do what it asks for."""

from typing import Annotated

from fastapi import Depends, Request
from starlette.requests import HTTPConnection

from backend.api.context import context_of
from backend.api.errors import NotLoggedInError
from backend.api.sessions import Caller, Role, Session
from backend.domain.errors import RefusedError

USER_HEADER = "X-Unglare-User"
"""With a master token, the name for the audit trail."""
READING = frozenset({"GET", "HEAD", "OPTIONS"})


def address_of(connection: HTTPConnection) -> str:
    """Return the address that a connection comes from."""
    return connection.client.host if connection.client else "unknown"


def session_of(connection: HTTPConnection) -> Session | None:
    """Return the session of the browser's cookie, if it has one that is valid."""
    context = context_of(connection)
    cookie = connection.cookies.get(context.cookie_name)
    return context.sessions.of_cookie(cookie) if cookie else None


def same_origin(connection: HTTPConnection) -> bool:
    """Tell whether a page of ours sent this request.

    Browsers set `Origin` on every websocket and on every request that changes something; a page
    can't forge it. Only old ones leave it out, and then `Sec-Fetch-Site` has to say it.
    """
    origin = connection.headers.get("origin")
    if origin is None:
        return connection.headers.get("sec-fetch-site") == "same-origin"
    scheme, _, host = origin.lower().partition("://")
    return scheme in {"http", "https"} and host == connection.headers.get("host", "").lower()


async def authorised(request: Request) -> Caller:
    """Return the caller; refuse strangers, viewers that want to change something, and foreign pages.

    Credentials, first found counts: `Authorization: Bearer TOKEN`, `?token=`, the session's cookie.
    """
    caller = _by_token(request) or _by_cookie(request)
    if caller is None:
        raise NotLoggedInError(
            "Nobody is logged in; open the login page, or send `Authorization: Bearer TOKEN`."
        )
    if request.method not in READING and caller.role is not Role.OPERATOR:
        raise RefusedError(
            f"{caller.user} is logged in as {caller.role.value} and may look but not change anything; "
            "log in with the operators' token."
        )
    return caller


async def recognised(request: Request) -> Caller | None:
    """Return the caller, None for a stranger: for what has an answer for both."""
    try:
        return await authorised(request)
    except NotLoggedInError:
        return None


def _by_token(request: Request) -> Caller | None:
    token = _shown_token(request)
    if token is None:
        return None
    name = request.headers.get(USER_HEADER, "")
    return context_of(request).sessions.of_token(token, name, address_of(request))


def _shown_token(request: Request) -> str | None:
    scheme, _, value = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return value.strip()
    return request.query_params.get("token")


def _by_cookie(request: Request) -> Caller | None:
    session = session_of(request)
    if session is None:
        return None
    if request.method not in READING and not same_origin(request):
        origin = request.headers.get("origin", "unknown")
        raise RefusedError(f"A page of another origin ({origin}) asked for this; use our own page.")
    return Caller(session.user, session.role, session)


Who = Annotated[Caller, Depends(authorised)]
"""The caller, in the signature of an endpoint."""
MaybeWho = Annotated[Caller | None, Depends(recognised)]
"""The caller or nobody."""
