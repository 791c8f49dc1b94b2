"""Pictures of the live page for the README: `python -m tests.live.screenshots DIR`.

A simulated meter is acquired for some time by the same command that a user gives, and Chromium looks at it.
"""

import sys
import tempfile
import time
from pathlib import Path

from tests.live.browser import acquiring, browsing, complaints, resize

WARM_UP_S = 62.0  # so that a minute of readings fills the charts
PICTURES = {
    "desktop-light": (1280, 800, 1.0, False),
    "desktop-dark": (1280, 800, 1.0, True),
    "phone-light": (390, 844, 2.0, False),
    "phone-dark": (390, 844, 2.0, True),
}


def main(folder: Path, warm_up_s: float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as recordings, acquiring(Path(recordings)) as (url, _), browsing() as browser:
        browser.get(url)
        time.sleep(warm_up_s)
        for name, (width, height, ratio, dark) in PICTURES.items():
            resize(browser, width, height, ratio=ratio, dark=dark)
            time.sleep(1.5)
            (folder / f"{name}.png").write_bytes(browser.get_screenshot_as_png())
            print(folder / f"{name}.png")
        for complaint in complaints(browser):
            print(complaint, file=sys.stderr)


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else WARM_UP_S)
