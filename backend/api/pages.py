"""Pages outside the station: login, logout, help files, import, and the one that waits for the station."""

from urllib.parse import quote, urlsplit

from fastapi import APIRouter, Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response

from backend.api.access import address_of, same_origin, session_of
from backend.api.assets import PUBLIC, asset, filled, help_page
from backend.api.context import Context, context_of
from backend.api.errors import NotLoggedInError, TooManyAttemptsError
from backend.api.headers import FRAMED_BY_US
from backend.api.sessions import LONGEST_NAME, tidy_name
from backend.domain.errors import NotFoundError, RefusedError

HOME = "/station/"
_LONGEST_FORM_FIELD = 1000

router = APIRouter(include_in_schema=False)


@router.get("/")
async def root(request: Request) -> Response:
    """Lead to the station, or log in by the link that the terminal shows."""
    if "token" in request.query_params:
        return login_by_link(request, HOME)
    return RedirectResponse(HOME, 303)


@router.get("/login")
async def login_form(request: Request, next: str = HOME) -> Response:  # noqa: A002 RUF100  as browsers know it
    """Show the login form; whoever is logged in already goes on."""
    if "token" in request.query_params:
        return login_by_link(request, next)
    if session_of(request) is not None:
        return RedirectResponse(own_address(next), 303)
    return _login_page(request, own_address(next))


@router.get("/login/who")
async def who_is_logged_in(request: Request) -> Response:
    """Tell the login page whether there is a session already, which a link from elsewhere can't show."""
    session = session_of(request)
    return JSONResponse({"user": session.user if session else None})


@router.post("/login")
async def log_in(request: Request) -> Response:
    """Open a session for the name and token of the form."""
    async with request.form(max_files=0, max_fields=8) as form:
        fields = {
            key: str(form.get(key, ""))[:_LONGEST_FORM_FIELD] for key in ("name", "token", "next")
        }
    target = own_address(fields["next"])
    if request.headers.get("origin") and not same_origin(request):
        return _login_page(
            request, target, error="This form was sent by another page; use this one.", status=403
        )
    name = tidy_name(fields["name"])
    if not name:
        return _login_page(
            request,
            target,
            error="Type your name: the audit trail says who decided what.",
            status=422,
        )
    try:
        return _logged_in(request, name, fields["token"].strip(), target)
    except (NotLoggedInError, TooManyAttemptsError) as error:
        return _login_page(request, target, name=name, error=error.sentence, status=error.status)


@router.get("/logout")
async def logout_form(request: Request) -> Response:
    """Ask once more: a link must not end anything by itself."""
    session = session_of(request)
    if session is None:
        return RedirectResponse("/login", 303)
    return HTMLResponse(filled("logout.html", user=session.user, role=session.role.value))


@router.post("/logout")
async def log_out(request: Request) -> Response:
    """End the session: its cookie dies, its sockets and streams close."""
    session = session_of(request)
    if session is not None:
        if not same_origin(request):
            raise RefusedError("Another page asked for the logout; use ours.")
        context_of(request).sessions.end(session)
    answer = RedirectResponse("/login", 303)
    context = context_of(request)
    for name in (context.cookie_name, context.ticket_name):
        answer.delete_cookie(name, path="/", httponly=True, samesite="strict")
    return answer


@router.get("/import")
async def import_form(request: Request) -> Response:
    """Show the page that uploads a captured folder."""
    session = session_of(request)
    if session is None:
        return login_page_for(request)
    limit = context_of(request).upload_limit_bytes
    return HTMLResponse(filled("import.html", user=session.user, limit=f"{limit / 2**20:,.0f} MiB"))


@router.get("/help")
def operators_help() -> Response:
    """Show the operators' help, also to somebody who can't get in yet, and inside the station."""
    return HTMLResponse(help_page(), headers=FRAMED_BY_US)


@router.get("/assets/{name}")
async def public_file(name: str, request: Request) -> Response:
    """Serve a file that the pages need; they are public and checked anew each time."""
    if name not in PUBLIC:
        raise NotFoundError(f"There is no file {name!r} among the public assets.")
    content, tag = asset(name)
    headers = {"ETag": tag, "Cache-Control": "no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(content, media_type=PUBLIC[name], headers=headers)


def login_page_for(request: Request) -> Response:
    """Send somebody to the login page who then comes back here."""
    here = request.url.path
    if request.url.query:
        here = f"{here}?{request.url.query}"
    return RedirectResponse("/login" if here == HOME else f"/login?next={quote(here)}", 303)


def login_by_link(request: Request, target: str) -> Response:
    """Log in with `?token=` and lead to the page without it, so that the token leaves the address bar."""
    token, name = request.query_params.get("token", ""), request.query_params.get("user", "")
    try:
        return _logged_in(request, name, token, own_address(target))
    except (NotLoggedInError, TooManyAttemptsError) as error:
        return _login_page(request, own_address(target), error=error.sentence, status=error.status)


def starting_page(context: Context) -> Response:
    """Say that the station isn't up yet; the page asks again by itself."""
    page = filled("starting.html", message=context.station.message)
    return HTMLResponse(page, 503, headers={"Retry-After": "2"})


def own_address(address: str) -> str:
    """Return the address if it is one of ours, else home: `?next=` must not lead to a stranger.

    Examples
    --------
    >>> own_address("/api/docs")
    '/api/docs'
    >>> own_address("//evil.example/")
    '/station/'
    """
    try:
        parts = urlsplit(address)
    except ValueError:
        return HOME
    ours = address.startswith("/") and not parts.scheme and not parts.netloc
    # Browsers read a backslash as a slash, and skip control characters.
    return address if ours and address.isprintable() and "\\" not in address else HOME


def keep_in_browser(
    answer: Response, request: Request, name: str, secret: str, *, lifetime_s: float
) -> None:
    """Give the browser a secret that no script and no other site can read or send."""
    answer.set_cookie(
        name,
        secret,
        max_age=int(lifetime_s),
        path="/",
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )


def _logged_in(request: Request, name: str, token: str, target: str) -> Response:
    context = context_of(request)
    cookie, _ = context.sessions.login(name, token, address_of(request))
    answer = RedirectResponse(target, 303)
    lifetime_s = context.sessions.lifetime_s
    keep_in_browser(answer, request, context.cookie_name, cookie, lifetime_s=lifetime_s)
    return answer


def _login_page(
    request: Request, target: str, *, name: str = "", error: str = "", status: int = 200
) -> Response:
    page = filled(
        "login.html",
        next=target,
        name=name,
        error=error,
        longest=str(LONGEST_NAME),
        version=context_of(request).version,
    )
    return HTMLResponse(page, status)
