"""Procedural textures: `make(name)` returns an 8-bit sRGB picture, row 0 at v = 0.

Each name has a fixed random seed, so textures are the same on every machine.
"""

import zlib

import numpy as np
from jaxtyping import Float, UInt8

from tools.reference_street.terrain import NEAR_X, NEAR_Y

Image = Float[np.ndarray, "h w 3"]
PLAIN_TONES = 0.02  # standard deviation of the broad tones of plain materials


def noise(shape: tuple[int, int], slope: float, rng: np.random.Generator, stretch: float = 1.0):
    """Return tileable noise with amplitude frequency^-slope, mean 0, standard deviation 1."""
    fy = np.fft.fftfreq(shape[0])[:, None] * shape[0]
    fx = np.fft.rfftfreq(shape[1])[None, :] * shape[0] * stretch
    r = np.hypot(fy, fx)
    r[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.normal(size=shape)) * r**-slope
    spectrum[0, 0] = 0.0
    out = np.fft.irfft2(spectrum, s=shape)
    return out / out.std()


def _flat(shape, colour) -> Image:
    return np.broadcast_to(np.asarray(colour, float) / 255.0, (*shape, 3)).copy()


def _mix(image: Image, colour, amount) -> None:
    image += amount[..., None] * (np.asarray(colour, float) / 255.0 - image)


def _metres(shape, width: float, height: float):
    """Return texel-centre coordinates in metres: x along the columns, y along the rows."""
    y = (np.arange(shape[0]) + 0.5) * height / shape[0]
    x = (np.arange(shape[1]) + 0.5) * width / shape[1]
    return np.meshgrid(x, y)


def _asphalt(rng) -> Image:
    shape = (3072, 352)  # 48 m of road, 5.44 m wide
    x, y = _metres(shape, 5.44, 48.0)
    image = _flat(shape, (112, 112, 114))
    grain = noise(shape, 0.2, rng)
    image *= (1 + 0.07 * grain + 0.07 * noise(shape, 1.1, rng))[..., None]
    for wheel in (0.75, 2.0, 3.4, 4.7):  # tyre tracks are lighter
        _mix(image, (142, 141, 140), 0.35 * np.exp(-(((x - wheel) / 0.22) ** 2)))
    for _ in range(9):  # repairs
        x0, y0 = rng.uniform(0, 4.2), rng.uniform(0, 45)
        w, h = rng.uniform(0.7, 1.8), rng.uniform(0.9, 3.0)
        inside = (x > x0) & (x < x0 + w) & (y > y0) & (y < y0 + h)
        seam = inside & ~(
            (x > x0 + 0.05) & (x < x0 + w - 0.05) & (y > y0 + 0.05) & (y < y0 + h - 0.05)
        )
        shade = rng.uniform(68, 96)
        _mix(image, (shade, shade, shade + 3), 0.75 * inside)
        _mix(image, (48, 48, 50), 0.8 * seam)
    crack = noise(shape, 1.6, rng)
    _mix(image, (58, 57, 56), 0.7 * (np.abs(crack) < 0.012) * (noise(shape, 2.0, rng) > 0.3))
    dash = (np.abs(x - 2.72) < 0.07) & (np.mod(y, 6.0) < 3.0)
    worn = np.clip(0.85 + 0.25 * noise(shape, 0.6, rng), 0.2, 1.0)
    _mix(image, (226, 224, 214), dash * worn)
    for cx, cy in ((1.55, 21.0), (3.9, 44.2)):  # manhole covers
        r = np.hypot(x - cx, y - cy)
        plate = 74 + 26 * ((np.mod(x, 0.1) < 0.05) ^ (np.mod(y, 0.1) < 0.05))
        image[r < 0.34] = (plate / 255.0)[r < 0.34][:, None]
        image[(r > 0.30) & (r < 0.36)] = 0.2
    return image


def _blocks(shape, size, course, length, bond, colours, joint, joint_colour, rng) -> Image:
    """Draw courses of bricks, slabs or tiles with random colours and joints of `joint` m."""
    x, y = _metres(shape, *size)
    row = np.floor(y / course).astype(int)
    shifted = x + bond * length * (row % 2)
    columns = round(size[0] / length)
    column = np.floor(shifted / length).astype(int) % columns
    rows = row.max() + 1
    palette = np.asarray(colours, float) / 255.0
    pick = palette[rng.integers(len(palette), size=(rows, columns))]
    pick = pick * rng.normal(1.0, 0.09, size=(rows, columns, 1))
    image = pick[row, column]
    image *= (1 + 0.05 * noise(shape, 0.3, rng) + 0.05 * noise(shape, 1.2, rng))[..., None]
    gap = (np.mod(y, course) < joint) | (np.mod(shifted, length) < joint)
    _mix(image, joint_colour, 0.85 * gap)
    return image


def _brick(rng) -> Image:
    colours = [(168, 84, 62), (150, 70, 54), (182, 100, 72), (134, 62, 52), (172, 92, 74)]
    image = _blocks((640, 768), (3.84, 3.2), 0.08, 0.24, 0.5, colours, 0.013, (196, 184, 166), rng)
    return image


def _slabs(rng) -> Image:
    colours = [(176, 170, 160), (164, 160, 152), (186, 180, 168), (156, 152, 146), (172, 162, 152)]
    shape = (2400, 186)
    image = _blocks(shape, (1.86, 24.0), 0.60, 0.62, 0.0, colours, 0.018, (92, 90, 82), rng)
    _mix(image, (104, 100, 92), np.clip(0.25 * (noise(shape, 1.5, rng) - 0.8), 0, 0.5))
    moss = (np.mod(_metres(shape, 1.86, 24.0)[1], 0.6) < 0.04) & (noise(shape, 1.0, rng) > 0.8)
    _mix(image, (94, 104, 62), 0.7 * moss)
    return image


def _kerb(rng) -> Image:
    shape = (1152, 24)  # 9 m long, 0.16 m across
    y = _metres(shape, 0.16, 9.0)[1]
    stone = rng.normal(1.0, 0.06, size=10)[np.floor(y / 0.9).astype(int)]
    image = _flat(shape, (182, 178, 170)) * (stone * (1 + 0.05 * noise(shape, 0.5, rng)))[..., None]
    _mix(image, (84, 82, 78), 0.8 * (np.mod(y, 0.9) < 0.02))
    return image


def _concrete(rng) -> Image:
    shape = (1152, 64)
    y = _metres(shape, 0.26, 9.0)[1]
    image = _flat(shape, (146, 143, 136))
    image *= (1 + 0.06 * noise(shape, 0.5, rng) + 0.07 * noise(shape, 1.5, rng))[..., None]
    _mix(image, (90, 88, 82), 0.7 * (np.mod(y, 0.75) < 0.02))
    return image


def _grass(shape, rng) -> Image:
    image = _flat(shape, (98, 119, 58))
    broad, fine = noise(shape, 1.7, rng), noise(shape, 0.35, rng)
    _mix(image, (134, 140, 76), np.clip(0.3 * (broad - 0.2), 0, 0.6))
    _mix(image, (72, 98, 48), np.clip(0.3 * (-broad - 0.2), 0, 0.6))
    image *= (1 + 0.16 * fine + 0.10 * noise(shape, 1.0, rng))[..., None]
    return image


def _lawn(rng) -> Image:
    shape = (2304, 1536)  # 72 m by 48 m, 3.1 cm a texel
    x, y = _metres(shape, 2 * NEAR_X, 2 * NEAR_Y)
    x, y = x - NEAR_X, y - NEAR_Y
    image = _grass(shape, rng)
    mown = np.sign(np.sin(2 * np.pi * y / 2.4)) * ((x > 5) | (x < -5))
    image *= (1 + 0.035 * mown)[..., None]
    patchy = noise(shape, 1.1, rng)
    _mix(image, (134, 112, 80), np.clip(1.4 * (patchy - 2.3), 0, 0.85))  # bare earth
    for colour, level in (((240, 240, 232), 3.35), ((236, 206, 70), 3.5)):  # daisies, dandelions
        where = noise(shape, 0.0, rng) + 0.6 * noise(shape, 1.3, rng) > level
        _mix(image, colour, 0.9 * where)
    for cx, cy, radius in ((-7.6, 6.6, 2.2), (9.3, -8.6, 1.6)):  # leaves and earth below trees
        r = np.hypot(x - cx, y - cy) / radius
        _mix(image, (120, 104, 64), 0.55 * np.exp(-(r**2)) * (noise(shape, 0.2, rng) > 0.4))
        _mix(image, (92, 76, 54), 0.8 * np.exp(-((r * 2.6) ** 2)))
    _garden(image, x, y, rng)
    return image


def _garden(image: Image, x, y, rng) -> None:
    """Draw the slab paths to the two doors, and earth under the hedges and by the walls."""
    shape = x.shape
    for x0, x1, y0, y1 in ((-10.6, -5.0, -3.1, -1.9), (5.0, 10.1, 7.9, 9.1)):
        inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        slab = np.floor((x - x0) / 0.6).astype(int) % 64
        stone = rng.normal(1.0, 0.07, size=64)[slab] * (1 + 0.05 * noise(shape, 0.6, rng))
        image[inside] = (stone[..., None] * np.array([0.70, 0.64, 0.56]))[inside]
        joint = inside & ((np.mod(x - x0, 0.6) < 0.04) | (np.abs(y - y0 - 0.6) < 0.02))
        image[joint] = 0.36
    for x0, x1, y0, y1 in ((-6.35, -5.15, -12.2, -3.6), (5.4, 6.6, 9.8, 17.2)):
        earth = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        _mix(image, (92, 74, 56), 0.8 * earth)
    edge = np.minimum(
        np.abs(x + 10.5) + 99 * (np.abs(y + 2.5) > 4.9),
        np.abs(x - 10.0) + 99 * (np.abs(y - 8.5) > 4.9),
    )
    _mix(image, (104, 86, 64), 0.8 * np.clip(1.6 - edge / 0.35, 0, 1))  # flower beds by the walls


def _plain(shape, colour, rng) -> Image:
    """Return one colour with broad tones alone, which no feature detector finds."""
    return _flat(shape, colour) * (1 + PLAIN_TONES * noise(shape, 2.0, rng))[..., None]


def _asphalt_plain(rng) -> Image:
    return _plain((3072, 352), (108, 108, 110), rng)


def _lawn_plain(rng) -> Image:
    shape = (2304, 1536)
    x, y = _metres(shape, 2 * NEAR_X, 2 * NEAR_Y)
    x, y = x - NEAR_X, y - NEAR_Y
    image = _plain(shape, (98, 117, 60), rng)
    for cx, cy, radius in ((-7.6, 6.6, 2.2), (9.3, -8.6, 1.6)):  # earth below trees
        r = np.hypot(x - cx, y - cy) / radius
        _mix(image, (92, 76, 54), 0.8 * np.exp(-((r * 2.6) ** 2)))
    _garden(image, x, y, rng)
    return image


def _meadow_plain(rng) -> Image:
    return _plain((1024, 1024), (102, 118, 62), rng)


def _meadow(rng) -> Image:
    shape = (1024, 1024)  # 30 m
    image = _grass(shape, rng)
    _mix(image, (150, 142, 78), np.clip(0.25 * (noise(shape, 1.5, rng) - 0.3), 0, 0.5))
    return image


def _tiles(colours):
    def draw(rng) -> Image:
        shape, size = (704, 704), (3.52, 3.52)
        image = _blocks(shape, size, 0.32, 0.22, 0.5, colours, 0.012, (52, 42, 38), rng)
        x, y = _metres(shape, *size)
        up = np.mod(y, 0.32) / 0.32  # v runs up the roof; dark below the next course
        image *= (1.06 - 0.30 * up**3 - 0.55 * (up < 0.10))[..., None]
        wave = np.cos(2 * np.pi * (x + 0.11 * (np.floor(y / 0.32) % 2)) / 0.22)
        image *= (1 + 0.07 * wave)[..., None]
        _mix(image, (96, 98, 74), np.clip(0.3 * (noise(shape, 1.6, rng) - 0.7), 0, 0.5))
        return image

    return draw


def _plaster(rng) -> Image:
    shape = (768, 768)  # 6 m
    image = _flat(shape, (226, 210, 176))
    image *= (1 + 0.025 * noise(shape, 0.4, rng) + 0.035 * noise(shape, 1.6, rng))[..., None]
    streak = np.clip(noise(shape, 1.2, rng, stretch=0.15) - 1.0, 0, 2)
    _mix(image, (176, 160, 132), 0.12 * streak)
    return image


def _boards(colour, board: float, spread: float):
    def draw(rng) -> Image:
        shape, size = (512, 512), (2.0, 2.0)
        x, y = _metres(shape, *size)
        row = np.floor(y / board).astype(int)
        tone = rng.normal(1.0, spread, size=row.max() + 1)[row]
        image = _flat(shape, colour) * tone[..., None]
        image *= (1 + 0.08 * noise(shape, 0.9, rng, stretch=0.06))[..., None]
        _mix(image, (40, 32, 26), 0.75 * (np.mod(y, board) < 0.014))
        return image

    return draw


def _bark(rng) -> Image:
    shape = (512, 256)
    image = _flat(shape, (104, 86, 68))
    ridges = noise(shape, 0.8, rng, stretch=3.0)
    image *= np.clip(1 + 0.28 * ridges, 0.35, 1.7)[..., None]
    _mix(image, (110, 120, 82), np.clip(0.3 * (noise(shape, 1.5, rng) - 0.8), 0, 0.6))
    return image


def _palette(dark, bright, warm):
    def draw(rng) -> Image:
        t = np.linspace(0, 1, 64)[:, None]
        row = (1 - t) * np.asarray(dark, float) + t * np.asarray(bright, float)
        row *= rng.normal(1.0, 0.10, size=(64, 1))
        row[::7] = 0.5 * row[::7] + 0.5 * np.asarray(warm, float)
        return np.repeat(row[None] / 255.0, 4, axis=0)

    return draw


def _foliage(dark, bright):
    def draw(rng) -> Image:
        shape = (512, 512)  # 4 m of foliage
        image = _flat(shape, dark)
        _mix(image, bright, np.clip(0.5 + 0.35 * noise(shape, 0.9, rng), 0, 1))
        image *= (1 + 0.22 * noise(shape, 0.3, rng))[..., None]
        return image

    return draw


def _glass(_rng) -> Image:
    shape = (128, 128)  # one pane: dark room, a paler sky-like gradient, a curtain each side
    x, y = _metres(shape, 1.0, 1.0)
    image = _flat(shape, (44, 52, 60))
    _mix(image, (110, 126, 138), 0.55 * np.clip(y - 0.25 + 0.25 * x, 0, 1))
    curtain = np.clip(1 - np.minimum(x, 1 - x) / 0.17, 0, 1) > 0
    fold = 0.5 + 0.5 * np.sin(2 * np.pi * x / 0.055)
    _mix(image, (176, 168, 152), curtain * (0.45 + 0.25 * fold))
    return image


def _door(rng) -> Image:
    shape = (256, 128)  # one whole door
    x, y = _metres(shape, 1.0, 1.0)
    image = _flat(shape, (46, 82, 74)) * (1 + 0.04 * noise(shape, 0.8, rng))[..., None]
    for y0, y1 in ((0.07, 0.46), (0.52, 0.66)):
        for x0 in (0.12, 0.55):
            depth = np.minimum(np.minimum(x - x0, x0 + 0.33 - x), np.minimum(y - y0, y1 - y) * 2)
            image[(depth > 0) & (depth < 0.03)] *= 0.55
            image[depth > 0.03] *= 1.12
    light = (np.abs(x - 0.5) < 0.34) & (np.abs(y - 0.84) < 0.10)
    image[light] = np.array([60, 72, 80]) / 255.0
    image[np.hypot(x - 0.9, 2 * (y - 0.47)) < 0.035] = np.array([206, 178, 96]) / 255.0
    return image


def _paint(colour, rough: float = 0.03):
    def draw(rng) -> Image:
        shape = (128, 128)
        return _flat(shape, colour) * (1 + rough * noise(shape, 1.0, rng))[..., None]

    return draw


def _tyre(_rng) -> Image:
    shape = (128, 128)  # the end cap: u, v in the square around the disc
    x, y = _metres(shape, 1.0, 1.0)
    r, angle = np.hypot(x - 0.5, y - 0.5), np.arctan2(y - 0.5, x - 0.5)
    image = _flat(shape, (40, 40, 42))
    hub = (r < 0.33) & (((np.abs(np.sin(2.5 * angle)) > 0.42) | (r > 0.28)) | (r < 0.09))
    image[hub] = np.array([168, 170, 174]) / 255.0
    return image


def _car(part: str):
    def draw(_rng) -> Image:
        from tools.reference_street.objects import paint_car

        return paint_car(part)

    return draw


_DRAW = {
    "asphalt": _asphalt,
    "asphalt-plain": _asphalt_plain,
    "concrete": _concrete,
    "kerb": _kerb,
    "slabs": _slabs,
    "lawn": _lawn,
    "lawn-plain": _lawn_plain,
    "meadow": _meadow,
    "meadow-plain": _meadow_plain,
    "brick": _brick,
    "plaster": _plaster,
    "tiles-red": _tiles([(158, 82, 58), (142, 70, 52), (172, 96, 66), (128, 66, 54)]),
    "tiles-grey": _tiles([(98, 98, 104), (84, 86, 92), (112, 110, 112), (92, 88, 90)]),
    "boards": _boards((150, 112, 76), 0.16, 0.07),
    "bench-wood": _boards((168, 116, 68), 0.11, 0.09),
    "bark": _bark,
    "leaf-tree": _palette((52, 84, 34), (128, 158, 62), (168, 160, 66)),
    "leaf-birch": _palette((86, 104, 36), (176, 178, 74), (204, 170, 66)),
    "leaf-far": _palette((58, 84, 42), (122, 146, 72), (142, 146, 78)),
    "leaf-hedge": _palette((34, 66, 34), (86, 124, 54), (104, 128, 70)),
    "foliage-tree": _foliage((40, 62, 28), (86, 116, 48)),
    "foliage-hedge": _foliage((26, 46, 26), (52, 82, 40)),
    "foliage-far": _foliage((58, 80, 46), (104, 126, 66)),
    "glass": _glass,
    "door": _door,
    "white": _paint((228, 226, 218)),
    "stone": _paint((186, 180, 168), 0.06),
    "dark-metal": _paint((58, 62, 66)),
    "lamp-glass": _paint((236, 232, 214)),
    "snow": _paint((238, 240, 243), 0.0),
    "skin": _paint((196, 150, 124)),
    "coat-blue": _paint((52, 76, 122), 0.05),
    "coat-ochre": _paint((176, 128, 46), 0.05),
    "rubber": _paint((38, 38, 40)),
    "tyre": _tyre,
    "car-body": _car("body"),
    "car-cabin": _car("cabin"),
}
"""Functions that draw a texture; each is called with a random generator, needed or not."""
NAMES = tuple(_DRAW)


def make(name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return the texture of a name as 8-bit sRGB; row 0 is v = 0."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    return np.round(255 * np.clip(_DRAW[name](rng), 0.02, 0.95)).astype(np.uint8)
