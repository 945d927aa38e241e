"""Files of a result: JSON and CSV, from objects, rows or mappings."""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from weldcal.tools.console import plain
from weldcal.tools.report.render import write_atomic


def write_json(path: Path, content: object) -> None:
    """Write the content, in JSON's own types (what is not finite becomes null), with its folder."""
    write_atomic(path, json.dumps(plain(content), allow_nan=False, indent=1) + "\n")


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a header line and one line per row."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def mappings_csv(rows: Sequence[Mapping[str, object]], columns: Sequence[str] = ()) -> str:
    """Mappings, one line each: these keys, or all."""
    columns = columns or list(dict.fromkeys(key for row in rows for key in row))
    return csv_text(columns, ([row.get(name, "") for name in columns] for row in rows))
