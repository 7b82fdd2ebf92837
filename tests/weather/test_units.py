"""Units: valid and invalid quantities, ranges, and the help of the command line."""

import math
import subprocess
import sys
from dataclasses import dataclass

import pytest
import tyro

from climatenerf.core.errors import UserError
from climatenerf.weather import units
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.light.parameters import Sun
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather, check


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("0.5 m", units.LENGTH, 0.5),
        ("10 cm", units.LENGTH, 0.1),
        ("-30cm", units.LENGTH, -0.3),
        ("1.5e2 m", units.LENGTH, 150),
        ("1 km", units.LENGTH, 1000),
        ("3 ft", units.LENGTH, 0.9144),
        ("6 m/s", units.SPEED, 6),
        ("36 km/h", units.SPEED, 10),
        ("35 deg", units.ANGLE, math.radians(35)),
        ("35°", units.ANGLE, math.radians(35)),
        ("1 rad", units.ANGLE, 1),
        ("0.02 1/m", units.PER_LENGTH, 0.02),
        ("0.02 /m", units.PER_LENGTH, 0.02),
        ("2 per km", units.PER_LENGTH, 0.002),
        ("2 min", units.DURATION, 120),
    ],
)
def test_quantities_are_read_in_si_units(text, kind, value):
    assert units.parse_quantity(text, kind) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        *((text, units.LENGTH) for text in ("3 kg", "0.5", "m", "", "0,5 m", "nan m", "inf m")),
        *((text, units.LENGTH) for text in ("1e999 m", "9**9**9 m", "1 m**9**9", "1 xyz", "1 m)")),
        ("35", units.ANGLE),
        ("5 percent", units.ANGLE),
        ("5 m/m", units.ANGLE),
        ("6 m", units.SPEED),
        ("20 degC", units.LENGTH),
    ],
)
def test_invalid_quantities_are_refused(text, kind):
    with pytest.raises(UserError) as error:
        units.parse_quantity(text, kind, "--some.flag")
    assert str(error.value).startswith(
        f'--some.flag must be {kind.name} such as "{kind.example}"; got "{text}"'
    )


@pytest.mark.parametrize(
    "kind", [units.LENGTH, units.SHORT_LENGTH, units.SPEED, units.ANGLE, units.DURATION]
)
@pytest.mark.parametrize("value", [0.0, 0.1, 1 / 3, -2.0, 1e-9, 12345.678, 1e12, math.radians(37)])
def test_quantities_round_trip(kind, value):
    text = units.format_quantity(value, kind)
    assert units.parse_quantity(text, kind) == pytest.approx(value, rel=1e-15, abs=0)


def test_quantities_are_written_without_rounding_noise():
    assert units.format_quantity(0.5, units.LENGTH) == "0.5 m"
    assert units.format_quantity(math.radians(37), units.ANGLE) == "37 deg"
    assert units.format_quantity(3.0, units.SPEED) == "3 m/s"


@dataclass(frozen=True)
class Arguments:
    flood: Flood = Flood()
    smog: Smog = Smog()


def test_flags_have_units():
    seen = tyro.cli(Arguments, args=["--flood.level=-30 cm", "--flood.wind-speed", "10 knots"])
    assert seen.flood.level == pytest.approx(-0.3)
    assert seen.flood.wind_speed == pytest.approx(5.144, abs=1e-3)
    assert tyro.cli(Arguments, args=["--flood.level", "none"]).flood.level is None


def test_an_invalid_flag_prints_one_message_with_status_2(capsys):
    with pytest.raises(SystemExit) as stop:
        tyro.cli(Arguments, args=["--flood.level", "3 kg"])
    assert stop.value.code == 2
    printed = capsys.readouterr().err
    assert '--flood.level: must be a length such as "0.5 m"; got "3 kg"' in printed
    assert "Traceback" not in printed


def test_values_out_of_range_are_refused():
    assert check(Weather()) == Weather()
    check(Weather(sun=Sun(azimuth=math.radians(360)), snow=Snow(slope=math.radians(90))))
    for weather, message in (
        (Weather(flood=Flood(level=2e3)), "--flood.level must lie between -1000 m and 1000 m"),
        (Weather(flood=Flood(wind_speed=float("nan"))), "--flood.wind-speed must lie"),
        (Weather(smog=Smog(visibility=0.0)), "--smog.visibility must lie between 0.5 m"),
        (Weather(smog=Smog(colour=(1, 2, 1))), "--smog.colour must lie between 0 and 1; got 2"),
        (Weather(sun=Sun(elevation=math.radians(91))), "-90 deg and 90 deg; got 91 deg"),
        (Weather(seed=-1), "--seed must lie"),
        (Weather(smog=Smog(visibility=10.0, sigma=1.0)), "give only one"),
    ):
        with pytest.raises(UserError) as error:
            check(weather)
        assert message in str(error.value)


def test_every_parameter_has_a_range_and_no_section_is_too_long():
    for effect in EFFECTS:
        parameters = effect.fields()
        assert 0 < len(parameters) <= 17
        for parameter in parameters.values():
            if isinstance(parameter, units.Choice):
                assert len(set(parameter.words)) == len(parameter.words) > 1
            elif not isinstance(parameter, units.Folder):
                assert math.isfinite(parameter.low) and parameter.low < parameter.high


def test_help_shows_unit_and_range(capsys):
    with pytest.raises(SystemExit):
        tyro.cli(Arguments, args=["--help"])
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert 'LENGTH, e.g. "0.5 m"; -1000 m to 1000 m' in printed
    assert "FLOAT FLOAT FLOAT; 0 to 1000" in printed


def test_a_triple_can_be_none():
    args = ["--flood.attenuation", "0.1", "0.2", "0.3"]
    assert tyro.cli(Arguments, args=args).flood.attenuation == (0.1, 0.2, 0.3)
    none = ["--flood.attenuation", "none", "none", "none"]
    assert tyro.cli(Arguments, args=none).flood.attenuation is None


def test_descriptions_do_not_import_torch():
    """Help and weather files do not need torch, which takes seconds to import."""
    code = (
        "import sys, climatenerf.weather.registry, climatenerf.weather.description\n"
        "assert not {'torch', 'pint', 'numba'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
