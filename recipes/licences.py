"""Looks through the licences of everything that is installed: no GPL, nothing non-commercial, nothing unknown.

    python -m venv check && check/bin/pip install '.[train,ray,view,ros]'
    check/bin/python recipes/licences.py

Run it in an environment that has what users install and nothing else. Status 1 where a package may not be depended on.
"""

from __future__ import annotations

import argparse
import re
import sys
from importlib.metadata import Distribution, distributions

ALLOWED = re.compile(
    r"apache|\bmit\b|bsd|\bisc\b|\bpsf\b|python software|mozilla|mpl|zlib|unlicense|public domain|\bcc0|hpnd|boost"
    r"|any.osi",
    re.IGNORECASE,
)
REFUSED = re.compile(
    r"gpl|affero|general public|non.?commercial|\bnc\b|cc.by.nc|research only|proprietary", re.IGNORECASE
)
LESSER = re.compile(
    r"(?:gnu )?(?:lesser general public license|library or lesser general)[^;,]*|lgpl[^\s;,]*", re.IGNORECASE
)
KNOWN = {  # whose metadata says nothing that a program can read; looked up by hand in the package itself
    "improvo": "Apache-2.0",
    "openvino": "Apache-2.0; binaries under the same",
    "rosbags": "Apache-2.0",
}
SYSTEM = {"pip", "setuptools", "wheel"}
OWN_TERMS = re.compile(r"^(nvidia-|cuda-)")  # CUDA's redistributable libraries, which torch brings along on Linux


def main() -> None:
    """Print name, version and licence of every package."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    bad = []
    for package in sorted(distributions(), key=lambda one: (one.name or "").lower()):
        name = (package.name or "?").lower()
        if name in SYSTEM:
            continue
        licence = KNOWN.get(name) or licence_of(package)
        if OWN_TERMS.match(name):
            verdict = "own terms"
        elif may_depend_on(licence):
            verdict = "ok"
        else:
            verdict = "REFUSED"
            bad.append(name)
        print(f"{verdict:10} {name:40} {package.version:18} {licence[:80]}")
    if bad:
        sys.exit(f"not to be depended on, or unknown: {', '.join(bad)}")


def may_depend_on(licence: str) -> bool:
    """Whether one of its terms, or all of them, are among those that we take; the lesser GPL is one."""
    if " or " in licence.lower():
        return any(may_depend_on(part) for part in re.split(r"\s+or\s+", licence, flags=re.IGNORECASE))
    rest = LESSER.sub("", licence)
    return bool(ALLOWED.search(rest) or rest != licence) and not REFUSED.search(rest)


def licence_of(package: Distribution) -> str:
    """What the metadata says: the expression, else classifiers, else the first line of the text."""
    metadata = package.metadata
    expression = metadata.get("License-Expression")
    if expression:
        return str(expression)
    classifiers = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier", []) if "License ::" in line]
    text = (metadata.get("License") or "").strip().splitlines()
    return "; ".join(dict.fromkeys([*classifiers, *(text[:1])])) or "unknown"


if __name__ == "__main__":
    main()
