# For type checkers and editors: what `__init__.py` imports when it is first used.
from climatenerf import extend as extend
from climatenerf.api import evaluate as evaluate
from climatenerf.api import fit as fit
from climatenerf.api import load_run as load_run
from climatenerf.api import open_scene as open_scene
from climatenerf.api import render_movie as render_movie
from climatenerf.render.session import RenderSession as RenderSession
from climatenerf.weather.flood.parameters import Flood as Flood
from climatenerf.weather.light.parameters import Sun as Sun
from climatenerf.weather.smog.parameters import Smog as Smog
from climatenerf.weather.snow.parameters import Snow as Snow
from climatenerf.weather.weather import Weather as Weather

__version__: str
