"""Numbers as people read them, three digits each; a dash where there is none."""

from prt_torch.report.outcome import Number

MISSING = "–"
_BYTE_UNITS = ("B", "KiB", "MiB", "GiB", "TiB")
_TIME_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


def _three_digits(value: float) -> str:
    """Three significant digits without an exponent; more only before the point."""
    if value == 0:
        return "0"
    digits = f"{value:#.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if "e" in digits:  # rounding up to 1000, or a value too small for plain digits
        digits = f"{float(digits):.0f}" if abs(value) >= 1 else f"{value:.2e}"
    return digits.removesuffix(".")


def bytes_text(value: Number) -> str:
    """Bytes in binary units, such as ``1.50 MiB``."""
    if value is None:
        return MISSING
    size, unit = float(value), 0
    while size >= 1024 and unit < len(_BYTE_UNITS) - 1:
        size, unit = size / 1024, unit + 1
    digits = f"{size:.0f}" if unit == 0 else _three_digits(size)
    return f"{digits} {_BYTE_UNITS[unit]}"


def seconds_text(value: Number) -> str:
    """A time in the unit that suits it, such as ``12.3 ms``; minutes and hours from 100 s on."""
    if value is None:
        return MISSING
    if value == 0:
        return "0 s"
    if value >= 100:
        minutes = round(value / 60)
        return f"{minutes} min" if minutes < 120 else f"{value / 3600:.1f} h"
    scale, unit = next(((s, u) for s, u in _TIME_UNITS if value >= s * 0.9995), _TIME_UNITS[-1])
    return f"{_three_digits(value / scale)} {unit}"


def error_text(value: Number) -> str:
    """A squared-error ratio, such as ``1.23e-04``; a plain 0 is exact."""
    if value is None:
        return MISSING
    return "0" if value == 0 else f"{value:.2e}"


def percent_text(value: Number) -> str:
    """A relative error as a percentage; scientific where it is below a thousandth of one."""
    if value is None:
        return MISSING
    if 0 < value < 1e-5:
        return f"{100 * value:.1e} %"
    return f"{_three_digits(100 * value)} %"


def factor_text(value: Number) -> str:
    """How many times smaller or faster, such as ``12.3×``."""
    return MISSING if value is None else f"{_three_digits(value)}×"


def digits_text(value: Number) -> str:
    """A number of decimal digits, such as ``2.7``."""
    return MISSING if value is None else f"{value:.1f}"


def count_text(value: Number) -> str:
    """A count with thousands separated."""
    return MISSING if value is None else f"{value:,.0f}"
