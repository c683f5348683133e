"""Trajectory errors as Markdown, laid out like the paper's Table 2."""

from __future__ import annotations

from typing import Any

from improvo.evaluation.tables import bold_best, columns_to_rows, markdown, significant

MANY_SEGMENTS = 10


def sub_trajectory_table(results: dict[str, dict[str, Any]], unit: str = "s") -> str:
    """Table 2: mean rotation and translation error per sub-trajectory length, best in bold.

    Args:
        results: name of the row -> trajectory errors as plain data (`trajectory.json`).
        unit: of the lengths: "s", as in the paper with a row for each run, or "m" or "path", of which there are more
            and which have a row for each run and length.
    """
    first = next(iter(results.values()))
    lengths = [row["length"] for row in first["relative"] if row["unit"] == unit]
    if not lengths:
        return ""
    windows = {name: [r for r in result["relative"] if r["unit"] == unit] for name, result in results.items()}
    shown = [_length(length, unit) for length in lengths]
    notes = {f"- {name}: {row['note']}" for name, rows in windows.items() for row in rows if row["note"]}
    table = _by_time(windows, shown) if unit == "s" else _by_length(windows, shown)
    return "\n\n".join([table, *(["\n".join(sorted(notes))] if notes else [])])


def _by_time(windows: dict[str, list[dict[str, Any]]], shown: list[str]) -> str:
    """A row for each run; the lengths beside each other."""
    header = ["Sub-trajectory length", *(f"{s} (°)" for s in shown), *(f"{s} (cm)" for s in shown)]
    none = ["No prediction"]
    columns: list[list[str]] = []
    fields = [("rotation_deg", 1.0), ("translation_m", 100.0)]
    for field, factor in fields:
        for i in range(len(shown)):
            still = _first_known([rows[i][f"no_prediction_{field}"] for rows in windows.values()])
            none.append(significant(None if still is None else factor * still))
            values = [factor * rows[i][field]["mean"] if rows[i][field] else None for rows in windows.values()]
            cells = [significant(value) for value in values]
            columns.append(bold_best(cells, values, largest=False) if len(values) > 1 else cells)
    return markdown(header, [none, *columns_to_rows(list(windows), columns)])


def _by_length(windows: dict[str, list[dict[str, Any]]], shown: list[str]) -> str:
    """A row for each run and length, with the error of no prediction at the same lengths."""
    header = [
        "Sub-trajectory length",
        "rot. (°)",
        "transl. (cm)",
        "transl. (%)",
        "none: rot. (°)",
        "none: transl. (cm)",
    ]
    rows = []
    for i, length in enumerate(shown):
        for name, entries in windows.items():
            entry = entries[i]
            rotation, translation = entry["rotation_deg"], entry["translation_m"]
            still = entry["no_prediction_translation_m"]
            figures = [
                rotation["mean"] if rotation else None,
                100 * translation["mean"] if translation else None,
                entry["translation_percent"],
                entry["no_prediction_rotation_deg"],
                None if still is None else 100 * still,
            ]
            label = length if len(windows) == 1 else f"{length}, {name}"
            rows.append([label, *map(significant, figures)])
    return markdown(header, rows)


def trajectory_tables(result: dict[str, Any], name: str) -> str:
    """One evaluation as Markdown: what was compared, ATE, segments, Table 2 by time, distance and share of path."""
    lines = [
        f"{result['poses']} poses at a common time, of {result['estimate_poses']} estimated and "
        f"{result['truth_poses']} true ones; {result['path_m']:.4g} m of path; alignment {result['alignment']}"
        + (", each segment on its own." if len(result["segments"]) > 1 else ".")
    ]
    invalid = result["invalid_truth"]
    if invalid:
        named = ", ".join(f"{time:.3f}" for time in invalid[:5]) + (", …" if len(invalid) > 5 else "")
        lines.append(f"Left out: {len(invalid)} true poses that are missing, NaN or not rigid (at {named} s).")
    parts = ["\n".join(lines), _absolute(result)]
    for unit in ("s", "m", "path"):
        table = sub_trajectory_table({name: result}, unit)
        if table:
            parts.append(table)
    return "\n\n".join(parts) + "\n"


def vo_tables(results: dict[str, Any]) -> str:
    """`vo.json` as Markdown: Table 2 over all sequences, and what each sequence gave."""
    named = {f"{row['frontend']} {row['variant']}".strip(): row for row in results["rows"]}
    parts = [sub_trajectory_table(named, "s"), sub_trajectory_table(named, "m")]
    header = ["Sequence, frontend", "frames", "with pose", "segments", "ATE (m)", "ATE (% of path)"]
    rows = []
    for row in results["sequence_rows"]:
        errors = row["errors"]
        ate = errors["ate_m"] if errors else None
        figures = [significant(ate["rmse"] if ate else None), significant(errors["ate_percent"] if errors else None)]
        label = f"{row['sequence']}, {row['frontend']} {row['variant']}".strip()
        segments = str(len(errors["segments"])) if errors else "0"
        rows.append([label, str(row["frames"]), str(row["tracked"]), segments, *figures])
    parts.append(markdown(header, rows))
    notes = [
        f"- {row['sequence']}, {row['frontend']}: {row['note']}" for row in results["sequence_rows"] if row["note"]
    ]
    notes += [f"- {entry['sequence']} left out: {entry['reason']}" for entry in results["excluded"]]
    notes += [f"- frontend {s['frontend']} not run: {s['reason']}" for s in results.get("skipped_frontends", ())]
    notes += [
        f"- {row['frontend']} has no stability head: all weights are 1" for row in results["rows"] if not row["variant"]
    ]
    return "\n\n".join(part for part in [*parts, "\n".join(notes)] if part) + "\n"


def _absolute(result: dict[str, Any]) -> str:
    header = [
        "Absolute trajectory error",
        "poses",
        "path (m)",
        "scale",
        "rmse (m)",
        "median",
        "max",
        "% of path",
        "rot. (°)",
    ]
    rows = []
    everything = {"poses": result["poses"], "scale": None, **result, "note": ""}
    entries = [(f"segment {s['segment']}", s) for s in result["segments"][:MANY_SEGMENTS]]
    if len(entries) == 1:
        everything["scale"] = result["segments"][0]["scale"]
        entries = []
    for label, entry in [*entries, ("all", everything)]:
        ate = entry["ate_m"]
        if ate is None:
            rows.append([label, str(entry["poses"]), f"{entry['path_m']:.4g}", *["-"] * 6])
            continue
        figures = [entry["scale"], ate["rmse"], ate["median"], ate["maximum"], entry["ate_percent"]]
        figures.append(entry["rotation_deg"]["rmse"])
        rows.append([label, str(entry["poses"]), f"{entry['path_m']:.4g}", *map(significant, figures)])
    notes = [f"- segment {s['segment']}: {s['note']}" for s in result["segments"][:MANY_SEGMENTS] if s["note"]]
    if len(result["segments"]) > MANY_SEGMENTS:
        notes.append(f"- {len(result['segments']) - MANY_SEGMENTS} further segments are in the JSON")
    return "\n\n".join([markdown(header, rows), *(["\n".join(notes)] if notes else [])])


def _length(length: float, unit: str) -> str:
    return f"{100 * length:g} % path" if unit == "path" else f"{length:g} {'sec' if unit == 's' else 'm'}"


def _first_known(values: list[float | None]) -> float | None:
    return next((value for value in values if value is not None), None)
