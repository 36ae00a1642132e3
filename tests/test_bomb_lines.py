"""Records of `bomb`: what they say together."""

from result_rows import read, values

from lerobot_bomb.results.instructions import named_targets, other_instructions


def test_the_other_instruction_names_another_target() -> None:
    targets = {"black 1": [0, 0], "black 2": [0, 1], "white 1": [0, 0], "white 2": [0, 1]}
    rows = [
        read(values(seed, instruction=name, target=at)) for seed, (name, at) in enumerate(targets.items())
    ]
    given = other_instructions(rows)
    assert sorted(given) == sorted(given.values()) == sorted(targets)
    assert all(targets[instruction] != targets[other] for instruction, other in given.items())


def test_where_all_episodes_have_one_target_there_is_no_other_instruction() -> None:
    assert other_instructions([read(values(seed, instruction=name)) for seed, name in enumerate("ab")]) == {}


def test_elsewhere_than_in_place_every_instruction_asks_for_something_of_its_own() -> None:
    rows = [
        read(values(seed, instruction=name, spec={"suite": "object"})) for seed, name in enumerate("abac")
    ]
    assert named_targets(rows) == {"a": "a", "b": "b", "c": "c"}
    given = other_instructions(rows)
    assert sorted(given) == sorted(given.values()) == ["a", "b", "c"]
    assert all(instruction != other for instruction, other in given.items())
    assert other_instructions(rows[:1] * 2) == {}
