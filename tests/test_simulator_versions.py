from simulator_versions import Measured, Outcome, from_dict, table


def outcome(states: str, images: str, error_mm: float = 0.31) -> Outcome:
    return Outcome(states, images, successes=9, episodes=10, worst_error_mm=error_mm)


def test_the_table_marks_what_equals_the_reference() -> None:
    reference = Measured(
        "3.8.1", "llvmpipe", {"scara none": outcome("a", "b"), "fetch none": outcome("c", "d")}
    )
    other = from_dict(
        {
            "mujoco": "4.0.0",
            "renderer": "llvmpipe",
            "outcomes": {
                "scara none": vars(outcome("a", "x", error_mm=78481.6)),
                "fetch none": "needs MuJoCo 3",
            },
        }
    )
    head, _, *rows = table([reference, other])
    assert head == "| MuJoCo | robot | states | images | none |"
    assert [row.strip("| ").split(" | ") for row in rows] == [
        ["3.8.1", "scara", "ca978112 =", "3e23e816 =", "9/10, 0.3 mm"],
        ["3.8.1", "fetch", "2e7d2c03 =", "18ac3e73 =", "9/10, 0.3 mm"],
        ["4.0.0", "scara", "ca978112 =", "2d711642", "9/10, 78481.6 mm"],
        ["4.0.0", "fetch", "", "", "cannot run"],
    ]
