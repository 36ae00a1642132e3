"""Scores of policies with each attention head put back, by nnsight: {name: (layers, heads)} as JSON.

A script, because nnsight adds an attribute to every Python object.
"""

import json
import sys
from typing import Any

import torch
from explain_cases import ask, loaded, without_image
from nnsight import NNsight
from torch import Tensor, nn

from lerobot_bomb.explain.question import Question


class Scored(nn.Module):
    """One row's score of the clean answer, by modules that nnsight can reach into."""

    def __init__(self, question: Question, policy: nn.Module):
        super().__init__()
        self.policy, self._question = policy, question

    def forward(self, **rows: Tensor) -> Tensor:
        return self._question.policy.score(rows, self._question.answer)


def scores_of(name: str) -> list[list[float]]:
    """(layers, heads)."""
    policy: Any = loaded(name).policy
    question = ask(loaded(name))
    corrupt = without_image(question)
    model: Any = NNsight(Scored(question, policy))
    text_model = f"policy.backbone.vlm.model.{policy.backbone.text_model_name}"
    layers = question.policy.layers
    scores = []
    with torch.no_grad():
        for number, layer in enumerate(layers):
            projection = f"{text_model}.layers.{number}.self_attn.o_proj"
            with model.trace(**question.rows):
                clean = model.get(projection).input.save()
            size = clean.shape[-1] // layer.num_heads
            of_layer = []
            for head in range(layer.num_heads):
                features = slice(head * size, (head + 1) * size)
                with model.trace(**corrupt):
                    model.get(projection).input[..., features] = clean[..., features]
                    score = model.output.save()
                of_layer.append(float(score))
            scores.append(of_layer)
    return scores


if __name__ == "__main__":
    print(json.dumps({name: scores_of(name) for name in sys.argv[1:]}))
