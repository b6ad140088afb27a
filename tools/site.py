"""Builds the site of the pages, and asks its search what newcomers ask: `make docs`.

A warning of Sphinx, or a question whose page is not the first one that the search shows, ends it
with 1. The search is that of the site, in Chromium, without a server.
"""

import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

ROOT = Path(__file__).parents[1]
SITE = ROOT / "build" / "site"
CHROMIUM = ("chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom")
FOUND = re.compile(r'<a href="(?:docs/)?([^"?#]+)\.html[^"]*" data-score')
# What a newcomer types, and the page with the answer.
QUESTIONS = {
    "what is zenoh": "faq",
    "raspberry": "computers",
    "windows": "computers",
    "unknown line": "operations",
    "import excel": "import",
    "first plant": "first-plant",
    "opc ua": "opcua",
    "home assistant": "integrate",
    "ros 2": "integrate",
    "docker": "deployment",
    "upgrade 0.1": "upgrade",
    "acknowledge alarm": "alarms",
    "mail webhook": "notify",
    "several tags recipe": "write-groups",
    "late reply": "late-replies",
    "dial modem": "modem",
    "standby": "standby",
    "prometheus": "metrics",
    "javascript": "languages",
    "export parquet": "charts",
    "slow link": "slow-links",
    "find a fault": "find-a-fault",
}


def build() -> None:
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"]
    subprocess.run([*command, "-c", "docs/site", ".", str(SITE)], cwd=ROOT, check=True)


def asked(question: str) -> list[str]:
    """The pages that the search shows, the best one first."""
    address = f"{(SITE / 'search.html').as_uri()}?q={quote(question)}"
    command = [*CHROMIUM, "--virtual-time-budget=20000", address]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return FOUND.findall(shown)


def main() -> int:
    build()
    late = 0
    for question, page in QUESTIONS.items():
        pages = asked(question)
        if pages[:1] != [page]:
            late += 1
            print(f"{question!r}: {page} is not before {', '.join(pages[:3])}")
    print(f"{len(QUESTIONS) - late} of {len(QUESTIONS)} questions lead to their page first")
    return 1 if late else 0


if __name__ == "__main__":
    sys.exit(main())
