"""Who may ask a view, and who may change something by it."""

from __future__ import annotations

import hmac
import ipaddress
import secrets

from aiohttp import web

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["HEADERS", "Guard", "is_loopback"]

_COOKIE = "uw_view_token"
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


class Guard:
    """Refuses other sites' pages and strangers.

    Parameters
    ----------
    address
        Where the view listens.
    token
        What a browser must know; drawn at random where another machine may reach the address and
        none is given. Empty on the loopback address: nobody is asked.
    """

    def __init__(self, address: str, token: str) -> None:
        self.token = token or ("" if is_loopback(address) else secrets.token_urlsafe(16))

    def refusal(self, request: web.Request) -> web.Response | None:
        """What a request gets that may not be answered, else None."""
        host = request.host.rsplit(":", 1)[0].strip("[]")
        if not self.token and not _is_own_name(host):
            # Another name that resolves to this machine is another site's doing.
            return web.Response(status=403, text=f"this view is not served as {host}")
        origin = request.headers.get("Origin")
        if origin is not None and origin != f"{request.scheme}://{request.host}":
            return web.Response(status=403, text="pages of other sites may not ask this view")
        if request.method not in ("GET", "HEAD") and (
            origin is None or request.content_type != "application/json"
        ):
            # Browsers say where what changes something comes from; a form cannot send this type.
            return web.Response(
                status=403,
                text="only the view's own page may change it: JSON, with an Origin",
            )
        if not self.token:
            return None
        given = request.query.get("token") or request.cookies.get(_COOKIE, "")
        if hmac.compare_digest(given.encode(), self.token.encode()):
            return None
        return web.Response(
            status=401, text="a token is needed: open the address that the view printed"
        )

    def remember(self, response: web.Response) -> None:
        """Have a browser that knows the token send it along from now on."""
        if self.token:
            response.set_cookie(_COOKIE, self.token, httponly=True, samesite="Strict")


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address.

    Raises
    ------
    InvalidInputError
        If it is no address.
    """
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError as error:
        raise InvalidInputError(
            f"address is {address!r}, expected an IP address such as 127.0.0.1, or localhost"
        ) from error


def _is_own_name(host: str) -> bool:
    try:
        return is_loopback(host)
    except InvalidInputError:
        return False
