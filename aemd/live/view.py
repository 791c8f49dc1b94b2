"""View: the live view as the pipeline sees it, a sink with a beginning and an end."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from aemd.live.access import Address, make_token, parse_address
from aemd.live.feed import About, Feed
from aemd.live.health import Sources
from aemd.live.inbox import Inbox
from aemd.live.options import LiveOptions
from aemd.live.runtime import announced
from aemd.live.server import Server

__all__ = ["View", "open_views"]


class View:
    """Listens from the moment it is made, so that a taken port is told of before the instrument is opened.

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

    @contextmanager
    def showing(self, about: About, sources: Sources) -> Iterator[None]:
        """Serve while inside."""
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
def open_views(live: str | None, options: LiveOptions) -> Iterator[list[View]]:
    """Open the live views that a command line asks for, and close them.

    Args:
        live: of `--live`: an address, empty for the default one, None for no page.
        options: the config's [live].

    Raises:
        UsageError: an address makes no sense or cannot be listened on.
    """
    with ExitStack() as stack:
        views = [] if live is None else [View(parse_address(live, Address(), "--live"), options)]
        for view in views:
            stack.callback(view.close)
        yield views
