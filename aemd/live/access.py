"""Who may look: the rules of address, Host, Origin and token, as functions of a request's headers.

Other pages in the user's browser must not read the measurements. They cannot see an answer of ours across origins
(there is no CORS), unless a name of theirs is made to point at this machine (DNS rebinding): then the browser takes us
for them, and only the Host header tells. So a Host must be an address in digits, which no one can rebind, or a name
that is ours.
"""

import hmac
import ipaddress
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from email.message import Message
from urllib.parse import urlsplit

from aemd.errors import UsageError

__all__ = ["Access", "Address", "Refusal", "make_token", "parse_address"]

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8410  # of the 34410A

Headers = Mapping[str, str] | Message


@dataclass(frozen=True, slots=True)
class Address:
    """Where to listen."""

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    """0 takes a free one."""

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return _is_loopback(self.host)

    @property
    def authority(self) -> str:
        """Host and port as a URL has them."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Refusal(Exception):  # noqa: N818 - it is one
    """Why a request gets no answer.

    Args:
        status: of HTTP: 400, 401, 403 or 503.
        reason: one line for who asked.
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def parse_address(text: str, default: Address, option: str) -> Address:
    """Read `HOST:PORT`, `HOST`, `:PORT` or `PORT`; what is missing is the default's.

    Raises:
        UsageError: it is none of these; `option` begins the message.

    >>> parse_address("0.0.0.0", Address(), "--live"), parse_address("[::1]:80", Address(), "--live")
    (Address(host='0.0.0.0', port=8410), Address(host='::1', port=80))
    >>> parse_address("0", Address(), "--live"), parse_address("", Address(), "--live") == Address()
    (Address(host='127.0.0.1', port=0), True)
    """
    wrong = UsageError(f"{option} {text}: must be HOST:PORT, HOST or PORT, with a port from 0 to 65535")
    if text.isdecimal():
        text = f":{text}"
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise wrong from error
    if parts.netloc != text or parts.username is not None or any(letter.isspace() for letter in text):
        raise wrong
    return Address(host or default.host, default.port if port is None else port)


class Access:
    """Decides on requests.

    Args:
        address: where the server listens, with its actual port.
        token: what a viewer must know; empty for none, on loopback only.
        hosts: further names by which this machine is reached, such as that of a proxy before it.

    Raises:
        ValueError: there is no token where other machines can reach us.
    """

    def __init__(self, address: Address, token: str, hosts: tuple[str, ...] = ()) -> None:
        if not token and not address.is_loopback:
            raise ValueError("other machines can reach this address: it needs a token")
        self._address = address
        self._token = token.encode()
        self._names = {"localhost", address.host.lower(), *(name.lower() for name in hosts)}
        if not address.is_loopback:
            name = socket.gethostname().lower()  # not getfqdn, which asks the name service and may wait for it
            self._names |= {name, f"{name}.local"}
        # Cookies know no ports: two acquisitions on one machine must not overwrite each other's.
        self._cookie = f"aemd-{address.port}"

    @property
    def needs_token(self) -> bool:
        """Whether a viewer must know one."""
        return bool(self._token)

    def check(self, headers: Headers, token_in_url: str | None) -> None:
        """Let a request pass.

        Raises:
            Refusal: a Host that is not ours, another site's page, or no token or a wrong one.
        """
        host = headers.get("Host", "")
        if not self._is_ours(host):
            raise Refusal(403, "this Host is not ours; use the address that aemd printed, or add it to [live] hosts")
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            raise Refusal(403, "another site's page asks: refused")
        if headers.get("Sec-Fetch-Site") in {"cross-site", "same-site"} and headers.get("Sec-Fetch-Mode") != "navigate":
            raise Refusal(403, "another site's page asks: refused")
        if self._token and not any(map(self._is_token, self._offered(headers, token_in_url))):
            raise Refusal(401, "the token is missing or wrong; use the address with ?token= that aemd printed")

    def cookie(self) -> str:
        """Return the Set-Cookie header that spares a browser the token in its URL."""
        return f"{self._cookie}={self._token.decode()}; Path=/; HttpOnly; SameSite=Strict"

    def _is_ours(self, host: str) -> bool:
        """Tell whether a Host header names us. The port is free: a tunnel's end has another one."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in self._names:
            return True
        try:
            literal = ipaddress.ip_address(name)
        except ValueError:
            return False
        return literal.is_loopback or not self._address.is_loopback

    def _offered(self, headers: Headers, token_in_url: str | None) -> list[str]:
        offered = [token_in_url or ""]
        scheme, _, credentials = headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            offered.append(credentials.strip())
        cookies = (pair.strip().partition("=") for pair in headers.get("Cookie", "").split(";"))
        return [*offered, *(value for name, _, value in cookies if name == self._cookie)]

    def _is_token(self, word: str) -> bool:
        return hmac.compare_digest(word.encode(errors="replace"), self._token)


def make_token() -> str:
    """Return a token that nobody guesses, of letters that a URL and a cookie take as they are."""
    return secrets.token_urlsafe(18)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
