"""Live views as the pipeline sees them: something with an inbox, a beginning and an end."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Protocol

from aemd.errors import UsageError
from aemd.live.access import Address, make_token, parse_address
from aemd.live.feed import About, Feed
from aemd.live.foxglove import DEFAULT_FOXGLOVE, Foxglove
from aemd.live.health import Sources
from aemd.live.inbox import Inbox
from aemd.live.options import LiveOptions
from aemd.live.runtime import announced
from aemd.live.server import Server

__all__ = ["Page", "View", "open_views"]


class View(Protocol):
    """One way to look at a running acquisition.

    It listens from the moment it is made, so that a taken port is told of before the instrument is opened.
    """

    @property
    def inbox(self) -> Inbox:
        """The sink that the pipeline writes to."""

    @property
    def url(self) -> str:
        """What to open."""

    @property
    def url_elsewhere(self) -> str:
        """What to open on another machine; empty where that is the same, or none can."""

    def showing(self, about: About, sources: Sources) -> AbstractContextManager[None]:
        """Serve while inside."""

    def close(self) -> None:
        """Stop listening. Twice is fine."""


class Page:
    """The page, its stream, status, health and metrics, over HTTP.

    Args:
        address: where to listen.
        options: the config's [live].

    Raises:
        UsageError: the address cannot be listened on.
    """

    def __init__(self, address: Address, options: LiveOptions) -> None:
        token = options.token or ("" if address.is_loopback else make_token())
        self.inbox = Inbox()
        self._server = Server(address, token, options.hosts)

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return self._server.url

    @property
    def url_elsewhere(self) -> str:
        """What to open on another machine, by this one's name; empty where that is the same, or none can."""
        return self._server.url_elsewhere

    @contextmanager
    def showing(self, about: About, sources: Sources) -> Iterator[None]:
        """Serve while inside, and let `aemd status` and `aemd watch` find us."""
        feed = Feed(self.inbox, about, sources)
        with announced(self.url, about.instrument):
            feed.start()
            self._server.start(feed)
            try:
                yield
            finally:
                feed.close()
                self._server.close()

    def close(self) -> None:
        """Stop listening. Twice is fine."""
        self._server.close()


@contextmanager
def open_views(live: str | None, options: LiveOptions, foxglove: str | None = None) -> Iterator[list[View]]:
    """Open the live views that a command line asks for, and close them.

    Args:
        live: of `--live`: an address, empty for the default one or, where that is taken, a free one, None for no page.
        options: the config's [live].
        foxglove: of `--foxglove`, likewise.

    Raises:
        UsageError: an address makes no sense or cannot be listened on, or a package is missing.
    """
    with ExitStack() as stack:
        views: list[View] = []
        if live is not None:
            views.append(_open_page(live, options))
            stack.callback(views[-1].close)
        if foxglove is not None:
            views.append(Foxglove(parse_address(foxglove, DEFAULT_FOXGLOVE, "--foxglove")))
            stack.callback(views[-1].close)
        yield views


def _open_page(live: str, options: LiveOptions) -> Page:
    """Open the page; that another acquisition of this machine has the default port is no reason not to acquire."""
    try:
        return Page(parse_address(live, Address(), "--live"), options)
    except UsageError:
        if live:
            raise
    return Page(Address(port=0), options)
