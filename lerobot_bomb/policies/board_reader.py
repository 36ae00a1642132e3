"""Reading of board and tray from image tokens: a training objective beside pointing.

Instructions name places, and stones, by the stones around them. A policy trained on actions and places alone
learns late to see the stones, and only then the places that depend on them.

Shapes: `B` batch, `P` image tokens of all cameras, `H` hidden size, `N` numbers of a token, `S` spots.
"""

from torch import Tensor, nn

from lerobot_bomb.bomb.board import COLORS
from lerobot_bomb.bomb.pointing import SPOTS_XY_M

NUM_SPOTS = len(SPOTS_XY_M)
NUM_STATES = 1 + len(COLORS)  # empty, or a stone of a colour
# sizes of the network's input and features: these read 88 % of the stones from eight tokens of 128 numbers
INPUT_DIM = 1024
HIDDEN_DIM = 256
LEAST_TOKEN_DIM = 4


class BoardReader(nn.Module):
    """A small network on image tokens, as the language model gets them.

    The more tokens there are, the fewer numbers each gives, so the network's size hardly depends on the
    backbone. Tokens are not averaged, which would blur where a stone lies.
    """

    def __init__(self, num_tokens: int, hidden_size: int):
        super().__init__()
        token_dim = max(LEAST_TOKEN_DIM, INPUT_DIM // num_tokens)
        self.tokens = nn.Linear(hidden_size, token_dim)
        self.read = nn.Sequential(
            nn.Linear(num_tokens * token_dim, HIDDEN_DIM),
            nn.SiLU(),
            nn.Linear(HIDDEN_DIM, NUM_SPOTS * NUM_STATES),
        )

    def forward(self, features_BPH: Tensor) -> Tensor:
        """(B, P, H) -> (B, S, NUM_STATES) logits."""
        numbers_BPN = self.tokens(features_BPH.float())
        return self.read(numbers_BPN.flatten(1)).unflatten(1, (NUM_SPOTS, NUM_STATES))
