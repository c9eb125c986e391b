"""FitVid's encoder of a frame, and the decoder that mirrors it and takes its features over skip connections.

Deviation: the decoder's last layer, which begins at zero, changes the logits of a known frame, where the original's
makes all of a frame. A network begins at copying that way, and what it learns are the changes; 50 minutes on
one core did not teach ours to draw the standing background anew as well as a copied frame shows it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from osfcore.experiments.rivals.fitvid.cells import DecoderCell, EncoderCell

COARSEST_SIDE = 8  # of the feature maps between encoder and decoder, as in the original [px]
_CELLS = 2  # of a stage
_LEAST = 1 / 256  # of a colour whose logit is taken

Skips = Sequence[Float[Tensor, "_ _ _ _"]]  # features after each of the encoder's cells, the finest first


class Encoder(nn.Module):
    """A frame as a vector: stages of two cells, all but the first beginning by halving the image, then a mean over it.

    Args:
        stages: their number; channels double from one to the next.
        width: channels of the first stage.
        features: length of the vector (g).
    """

    def __init__(self, stages: int, width: int, features: int) -> None:
        super().__init__()
        cells, before = [], 3
        for stage in range(stages):
            for cell in range(_CELLS):
                after = width * 2**stage
                cells.append(EncoderCell(before, after, 2 if stage > 0 and cell == 0 else 1))
                before = after
        self.cells = nn.ModuleList(cells)
        self.head = nn.Linear(before, features)

    def forward(self, frames: Float[Tensor, "B 3 h w"]) -> tuple[Float[Tensor, "B g"], list[Float[Tensor, "B _ _ _"]]]:
        """The vector of each frame, and the features after each cell."""
        # With colours last in memory, 1 x 1 convolutions of few channels at stride 2 crash PyTorch 2.13.
        skips, x = [], frames.contiguous()
        for cell in self.cells:
            x = cell(x)
            skips.append(x)
        return self.head(x.mean(dim=(2, 3))), skips


class Decoder(nn.Module):
    """A vector as a frame: a linear layer to the coarsest map, the encoder's stages backwards, a 3 x 3 convolution.

    After each cell the features of the encoder's cell across from it are added.

    Args:
        stages: of the encoder.
        width: channels of its first stage.
        features: length of the vector (g).
    """

    def __init__(self, stages: int, width: int, features: int) -> None:
        super().__init__()
        self._channels = before = width * 2 ** (stages - 1)
        self.ground = nn.Linear(features, before * COARSEST_SIDE**2)
        cells = []
        for stage in reversed(range(stages)):
            for cell in range(_CELLS):
                after = width * 2**stage
                cells.append(DecoderCell(before, after, grows=stage < stages - 1 and cell == 0))
                before = after
        self.cells = nn.ModuleList(cells)
        self.colours = nn.Conv2d(before, 3, 3, padding=1, bias=False)

    def forward(
        self, vectors: Float[Tensor, "B g"], skips: Skips, known: Float[Tensor, "_ 3 h w"]
    ) -> Float[Tensor, "B 3 h w"]:
        """Frames in [0, 1].

        Args:
            vectors: of frames.
            skips: of the encoder, for each of the vectors or of one frame for all of them.
            known: the frames of which those are.
        """
        x = self.ground(vectors).view(len(vectors), self._channels, COARSEST_SIDE, COARSEST_SIDE)
        for cell, skip in zip(self.cells, reversed(skips), strict=True):
            x = cell(x) + skip
        return (torch.logit(known, _LEAST) + self.colours(x).float()).sigmoid()
