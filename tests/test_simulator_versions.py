from simulator_versions import Measured, Outcome, cells


def outcome(states: str, images: str, error_mm: float = 0.31) -> Outcome:
    return {"states": 9 * states, "images": 9 * images, "successes": 9, "worst_error_mm": error_mm}


def measured(version: str, scara: Outcome, fetch: Outcome) -> Measured:
    return {"version": version, "outcomes": {"scara none": scara, "fetch none": fetch}}


def test_the_table_marks_what_equals_the_reference() -> None:
    reference = measured("3.8.1", outcome("a", "b"), outcome("c", "d"))
    other = measured("4.0.0", outcome("a", "x", error_mm=78481.6), {"error": "needs MuJoCo 3"})
    assert cells([reference, other]) == [
        ["3.8.1", "scara", "none", "aaaaaaaa =", "bbbbbbbb =", "9", "0.3 mm"],
        ["3.8.1", "fetch", "none", "cccccccc =", "dddddddd =", "9", "0.3 mm"],
        ["4.0.0", "scara", "none", "aaaaaaaa =", "xxxxxxxx", "9", "78481.6 mm"],
        ["4.0.0", "fetch", "none", "", "", "cannot run", ""],
    ]
