"""Layout of prompts: which parts follow each other, and where images are put in."""

import pytest
import torch
from policy_cases import CASES

from lerobot_bomb.actions.text import TokenRows
from lerobot_bomb.vlm.layout import Piece, PromptLayout

IMAGE = 9
PICTURE = [7, IMAGE, IMAGE, 8]
LAYOUT = PromptLayout(
    [
        Piece("start", [1]),
        Piece("left", PICTURE),
        Piece("right", PICTURE),
        Piece("instruction", None),
        Piece("state", [5]),
        Piece("state", None, width=3),
        Piece("end", [2, 3]),
    ],
    IMAGE,
)
# an instruction may have any token, even that of an image
ROWS = {
    "instruction": TokenRows(
        torch.tensor([[40, IMAGE], [42, 0]]), torch.tensor([[True, True], [True, False]])
    ),
    "state": TokenRows(
        torch.tensor([[50, 51, 52], [53, 0, 54]]), torch.tensor([3 * [True], [True, False, True]])
    ),
}


def test_the_pieces_are_joined_in_order() -> None:
    prompt = LAYOUT.fill(ROWS)
    assert prompt.ids.tolist() == [
        [1, *PICTURE, *PICTURE, 40, IMAGE, 5, 50, 51, 52, 2, 3],
        [1, *PICTURE, *PICTURE, 42, 0, 5, 53, 0, 54, 2, 3],
    ]
    assert (~prompt.mask).nonzero().tolist() == [[1, 10], [1, 13]]
    assert LAYOUT.num_tokens == 15  # and those of the instruction


@pytest.mark.parametrize("length", [0, 2, 5])
def test_the_instruction_has_the_columns_that_are_left(length: int) -> None:
    assert LAYOUT.spans(15 + length) == {
        "start": slice(0, 1),
        "left": slice(1, 5),
        "right": slice(5, 9),
        "instruction": slice(9, 9 + length),
        "state": slice(9 + length, 13 + length),
        "end": slice(13 + length, 15 + length),
    }


def test_images_take_the_place_of_their_tokens_alone() -> None:
    assert LAYOUT.image_columns(torch.device("cpu")).tolist() == [2, 3, 6, 7]
    features = torch.arange(1.0, 5.0, dtype=torch.float64)[None, :, None].expand(1, 4, 2)
    embeds = LAYOUT.with_images(torch.zeros(1, 17, 2), features)
    assert embeds.dtype == torch.float32
    assert embeds[0, :, 0].tolist() == [0, 0, 1, 2, 0, 0, 3, 4, *9 * [0]]


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_policys_spans_are_all_columns_and_hold_its_images(name: str) -> None:
    cases = CASES[name]
    policy = cases.make_policy(use_state=True)
    prompt = policy.prompt(cases.make_batch(policy, 3))
    spans = policy.layout.spans(prompt.ids.shape[1])
    columns = [column for span in spans.values() for column in range(span.start, span.stop)]
    assert columns == list(range(prompt.ids.shape[1]))
    assert {"start", "instruction", "state", "end", cases.WORKSPACE, cases.WRIST} == set(spans)
    for camera in (cases.WORKSPACE, cases.WRIST):
        is_image = prompt.ids[:, spans[camera]] == policy.layout.image
        assert is_image.sum(dim=1).tolist() == 3 * [policy.backbone.tokens_per_image]
    # rows differ in their instructions' lengths, and in the digits of their states
    padded = {part for part, span in spans.items() if not prompt.mask[:, span].all()}
    assert "instruction" in padded <= {"instruction", "state"}
