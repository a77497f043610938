"""Serial links under random faults: `run()` gives the figures of all links."""

from __future__ import annotations

from tests.studies.link_audit import LINKS, audit
from tests.support.figures import Figure, at_least, at_most


def run(transactions: int = 10**6) -> list[Figure]:
    """Of all links."""
    figures = []
    for name, (_, unit) in LINKS.items():
        found = audit(name, transactions)
        figures += [
            at_most(
                f"{name}: wrong values accepted",
                found.wrong,
                "",
                0,
                "transactions",
                found.transactions,
            ),
            at_most(f"{name}: largest error accepted", found.worst, unit),
            at_least(f"{name}: share accepted", found.believed / found.transactions, "", 0.5),
        ]
    return figures
