"""Residual cells of NVAE (Vahdat and Kautz, 2020) as FitVid uses them, and squeeze-and-excitation in them."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

EXPANSION = 4  # of the channels within a decoder's cell
_MOMENTUM, _EPSILON = 0.1, 1e-5
_SQUEEZE, _LEAST_SQUEEZED = 16, 4


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=_EPSILON, momentum=_MOMENTUM)


def _conv(before: int, after: int, side: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(before, after, side, stride, padding=side // 2, bias=False)


class SqueezeExcitation(nn.Module):
    """Channels scaled by what all of them are on average (Hu et al., 2018).

        y = x * sigmoid(E relu(R mean(x)))

    Args:
        channels: of x; a sixteenth of them, four at least, are in the middle.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        squeezed = max(channels // _SQUEEZE, _LEAST_SQUEEZED)
        self.reduce, self.expand = nn.Linear(channels, squeezed), nn.Linear(squeezed, channels)

    def forward(self, x: Float[Tensor, "B c h w"]) -> Float[Tensor, "B c h w"]:
        """The same with its channels scaled."""
        scale = self.expand(functional.relu(self.reduce(x.mean(dim=(2, 3))))).sigmoid()
        return x * scale[:, :, None, None]


class EncoderCell(nn.Module):
    """Two 3 x 3 convolutions, each behind batch norm and swish, and squeeze-and-excitation beside a shortcut.

    Args:
        before: channels.
        after: channels.
        stride: 2 to halve height and width.
    """

    def __init__(self, before: int, after: int, stride: int = 1) -> None:
        super().__init__()
        self.first, self.second = _conv(before, after, 3, stride), _conv(after, after, 3)
        self.norms = nn.ModuleList([_norm(before), _norm(after)])
        self.excitation = SqueezeExcitation(after)
        same = before == after and stride == 1
        self.shortcut = nn.Identity() if same else nn.Sequential(_conv(before, after, 1, stride), _norm(after))

    def forward(self, x: Float[Tensor, "B before h w"]) -> Float[Tensor, "B after h2 w2"]:
        """Features of the same or half the height and width."""
        y = self.first(functional.silu(self.norms[0](x)))
        y = self.second(functional.silu(self.norms[1](y)))
        return functional.silu(self.shortcut(x) + self.excitation(y))


class DecoderCell(nn.Module):
    """An inverted bottleneck: 1 x 1 to four times the channels, 5 x 5 among them, 1 x 1 back, beside a shortcut.

    The last batch norm begins with scale 0, so that the cell begins as its shortcut.

    Args:
        before: channels.
        after: channels.
        grows: whether height and width are doubled first, by repetition.
    """

    def __init__(self, before: int, after: int, *, grows: bool = False) -> None:
        super().__init__()
        inner = EXPANSION * after
        self.grows = grows
        self.widen, self.mix, self.narrow = _conv(before, inner, 1), _conv(inner, inner, 5), _conv(inner, after, 1)
        self.norms = nn.ModuleList([_norm(before), _norm(inner), _norm(inner), _norm(after)])
        nn.init.zeros_(self.norms[-1].get_parameter("weight"))
        self.excitation = SqueezeExcitation(after)
        same = before == after
        self.shortcut = nn.Identity() if same else nn.Sequential(_conv(before, after, 1), _norm(after))

    def forward(self, x: Float[Tensor, "B before h w"]) -> Float[Tensor, "B after h2 w2"]:
        """Features of the same or twice the height and width."""
        if self.grows:
            x = functional.interpolate(x, scale_factor=2, mode="nearest")
        y = self.widen(self.norms[0](x))
        y = self.mix(functional.silu(self.norms[1](y)))
        y = self.norms[3](self.narrow(functional.silu(self.norms[2](y))))
        return functional.silu(self.shortcut(x) + self.excitation(y))
