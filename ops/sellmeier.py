"""Refractive indices of optical glasses by Sellmeier's equation."""

import math
from numbers import Real
from typing import overload

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_kind
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.spans import working_dtype

LOW, HIGH = 310.0, 2300.0
"""Shortest and longest wavelength in nanometres."""

Terms = tuple[float, float, float]

SELLMEIER: dict[str, tuple[Terms, Terms]] = {
    # Schott's data sheets, January 2017, as the refractiveindex.info database (CC0) has them; at 20 °C, in air.
    # BK7 is N-BK7.
    "BK7": ((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)),
    "N-BK10": ((0.888308131, 0.328964475, 0.984610769), (0.00516900822, 0.0161190045, 99.7575331)),
    "N-K5": ((1.08511833, 0.199562005, 0.930511663), (0.00661099503, 0.024110866, 111.982777)),
    "N-FK5": ((0.844309338, 0.344147824, 0.910790213), (0.00475111955, 0.0149814849, 97.8600293)),
    "N-FK51A": ((0.971247817, 0.216901417, 0.904651666), (0.00472301995, 0.0153575612, 168.68133)),
    "N-PK51": ((1.15610775, 0.153229344, 0.785618966), (0.00585597402, 0.0194072416, 140.537046)),
    "N-BAK1": ((1.12365662, 0.309276848, 0.881511957), (0.00644742752, 0.0222284402, 107.297751)),
    "N-BAK4": ((1.28834642, 0.132817724, 0.945395373), (0.00779980626, 0.0315631177, 105.965875)),
    "N-SK2": ((1.28189012, 0.257738258, 0.96818604), (0.0072719164, 0.0242823527, 110.377773)),
    "N-SK16": ((1.34317774, 0.241144399, 0.994317969), (0.00704687339, 0.0229005, 92.7508526)),
    "N-SSK8": ((1.44857867, 0.117965926, 1.06937528), (0.00869310149, 0.0421566593, 111.300666)),
    "N-BAF10": ((1.5851495, 0.143559385, 1.08521269), (0.00926681282, 0.0424489805, 105.613573)),
    "N-LAK10": ((1.72878017, 0.169257825, 1.19386956), (0.00886014635, 0.0363416509, 82.9009069)),
    "N-LAK14": ((1.50781212, 0.318866829, 1.14287213), (0.00746098727, 0.0242024834, 80.9565165)),
    "N-LAK22": ((1.14229781, 0.535138441, 1.04088385), (0.00585778594, 0.0198546147, 100.834017)),
    "N-LAF2": ((1.80984227, 0.15729555, 1.0930037), (0.0101711622, 0.0442431765, 100.687748)),
    "N-LASF9": ((2.00029547, 0.298926886, 1.80691843), (0.0121426017, 0.0538736236, 156.530829)),
    "N-LASF44": ((1.78897105, 0.38675867, 1.30506243), (0.00872506277, 0.0308085023, 92.7743824)),
    "F2": ((1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764)),
    "N-F2": ((1.39757037, 0.159201403, 1.2686543), (0.00995906143, 0.0546931752, 119.248346)),
    "N-SF2": ((1.47343127, 0.163681849, 1.36920899), (0.0109019098, 0.0585683687, 127.404933)),
    "N-SF5": ((1.52481889, 0.187085527, 1.42729015), (0.011254756, 0.0588995392, 129.141675)),
    "N-SF6": ((1.77931763, 0.338149866, 2.08734474), (0.0133714182, 0.0617533621, 174.01759)),
    "N-SF10": ((1.62153902, 0.256287842, 1.64447552), (0.0122241457, 0.0595736775, 147.468793)),
    "N-SF11": ((1.73759695, 0.313747346, 1.89878101), (0.013188707, 0.0623068142, 155.23629)),
    "N-SF57": ((1.87543831, 0.37375749, 2.30001797), (0.0141749518, 0.0640509927, 177.389795)),
    "N-SF66": ((2.0245976, 0.470187196, 2.59970433), (0.0147053225, 0.0692998276, 161.817601)),
    "SF5": ((1.46141885, 0.247713019, 0.949995832), (0.0111826126, 0.0508594669, 112.041888)),
    "SF6": ((1.72448482, 0.390104889, 1.04572858), (0.0134871947, 0.0569318095, 118.557185)),
    "SF10": ((1.61625977, 0.259229334, 1.07762317), (0.0127534559, 0.0581983954, 116.60768)),
    "SF11": ((1.73848403, 0.311168974, 1.17490871), (0.0136068604, 0.0615960463, 121.922711)),
    # I. H. Malitson, "Interspecimen comparison of the refractive index of fused silica", J. Opt. Soc. Am. 55 (1965),
    # and "A redetermination of some optical properties of calcium fluoride", Appl. Opt. 2 (1963), at 20 and 24 °C.
    # The papers give resonance wavelengths, C is their square.
    "fused silica": ((0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2)),
    "CaF2": ((0.5675888, 0.4710914, 3.8484723), (0.050263605**2, 0.1003909**2, 34.64904**2)),
}
"""Of each glass (B1, B2, B3) and (C1, C2, C3), C in square micrometres."""


@overload
def refractive_index(glass: str, wavelength: float) -> float: ...
@overload
def refractive_index(glass: str, wavelength: Tensor) -> Tensor: ...
def refractive_index(glass: str, wavelength: float | Tensor) -> float | Tensor:
    """Index ``n`` of a glass by Sellmeier's equation, ``n² = 1 + Σ_i B_i λ² / (λ² - C_i)``.

    Dense flints are dark below some 380 nm; the equation goes on there, and nothing blows up.

    Args:
        glass: one of the names in `SELLMEIER`.
        wavelength: λ in nanometres, 310 to 2300; a number, or a floating-point tensor of any shape.

    Returns:
        A number for a number. For a tensor one of its shape and dtype, but float32 for half precision; it is worked
        out in double and has a gradient.

    Raises:
        TypeError: the wavelength is not a number or floating-point tensor.
        ValueError: an unknown glass, or a wavelength out of range.

    Source:
        "Efficient and Expressive Rendering for Real-Time Defocus Blur and Bokeh", (4.4).

    Example:
        >>> round(refractive_index("BK7", 587.5618), 5)
        1.5168
    """
    check_kind("glass", glass, str)
    if glass not in SELLMEIER:
        raise ValueError(f"glass: expected one of {', '.join(SELLMEIER)}, got {glass!r}")
    terms = tuple(zip(*SELLMEIER[glass], strict=True))
    if isinstance(wavelength, Tensor):
        if not wavelength.is_floating_point():
            raise TypeError(f"wavelength: expected a floating-point tensor, got {wavelength.dtype}")
        wrong = wavelength[~((wavelength >= LOW) & (wavelength <= HIGH))]  # NaN is wrong, too
        if len(wrong) > 0:
            raise ValueError(f"wavelength: expected {LOW:g} to {HIGH:g} nm, got {wrong[0].item():g}")
        squares = (wavelength.to(working_dtype(wavelength.device)) / 1000).square()
        index = sum((b * squares / (squares - c) for b, c in terms), torch.ones_like(squares)).sqrt()
        return index.to(compute_dtype(wavelength))
    if not isinstance(wavelength, Real) or isinstance(wavelength, bool):
        raise TypeError(f"wavelength: expected a number or a tensor, got {type(wavelength).__name__}")
    if not LOW <= wavelength <= HIGH:
        raise ValueError(f"wavelength: expected {LOW:g} to {HIGH:g} nm, got {wavelength:g}")
    square = (float(wavelength) / 1000) ** 2
    return math.sqrt(1 + sum(b * square / (square - c) for b, c in terms))
