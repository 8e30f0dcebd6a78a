"""Options that `swimm3r COMMAND --help` shows: those most users touch, under titles of their purpose.

--help-all shows every option. Commands that are not named here have few options, and show them all. An option that
the chosen back end or recipe does not have is left out.
"""

from swimm3r.cli.terminal.help_views import Groups

_INPUT = ("--fps", "--start", "--end", "--max-frames", "--masks")
_OUTPUT = ("--out", "--redo")
_SETTINGS = ("--preset", "--config")
_CAMERA = ("--housing", "--focal", "--adapter", "--weights")
_PAGE = ("--view",)
_MESSAGES = ("--quiet", "--verbose")

BRIEF: dict[tuple[str, ...], Groups] = {
    ("run",): {
        "input": _INPUT,
        "output": _OUTPUT,
        "speed and quality": (*_SETTINGS, "--recipe", "--map-device"),
        "camera and poses": ("--backend", *_CAMERA),
        "browser": _PAGE,
        "": _MESSAGES,
    },
    ("prepare",): {
        "input": (*_INPUT, "--pick", "--long-side", "--odd-sizes"),
        "output": _OUTPUT,
        "settings": _SETTINGS,
        "": _MESSAGES,
    },
    ("sfm",): {
        "input": _INPUT,
        "output": _OUTPUT,
        "speed and quality": _SETTINGS,
        "camera and poses": ("--backend", *_CAMERA, "--calibration", "--lens-from", "--reference"),
        "": _MESSAGES,
    },
    ("splat",): {
        "poses of another program": ("--colmap", "--transforms", "--images"),
        "output": _OUTPUT,
        "speed and quality": (*_SETTINGS, "--recipe", "--splat.iterations", "--splat.long-side", "--map-device"),
        "browser": _PAGE,
        "": _MESSAGES,
    },
    ("batch",): {
        "input": ("--fps", "--max-frames", "--masks"),
        "output": ("--out", "--redo", "--last-stage"),
        "speed and quality": (*_SETTINGS, "--recipe"),
        "place of the work": ("--engine", "--jobs", "--retries"),
        "camera and poses": ("--backend", "--housing", "--focal"),
        "": _MESSAGES,
    },
    ("train-sfm",): {
        "base network": ("--weights", "--base-license", "--device"),
        "output": ("--out",),
        "training": ("--recipe", "--epochs", "--batch", "--micro-batch", "--size", "--max-pairs", "--seed"),
        "": _MESSAGES,
    },
    ("localize",): {
        "input": ("--lens", "--rig-camera", "--stream", "--follow", "--idle", "--fps"),
        "output": ("--out", "--tum"),
        "matching": ("--matcher", "--weights", "--device", "--candidates", "--rounds", "--min-inliers"),
        "": _MESSAGES,
    },
    ("render",): {
        "cameras": ("--path", "--count", "--time"),
        "output": ("--out", "--long-side", "--video"),
        "speed": ("--map-device",),
        "": _MESSAGES,
    },
    ("scale",): {
        "lengths": ("--scale-bar", "--points", "--distances"),
        "markers": ("--markers", "--marker-size", "--marker-file"),
        "camera": ("--camera-height", "--laser-dots"),
        "navigation": ("--nav", "--nav-offset", "--clip-start", "--lever-arm"),
        "place": ("--crs", "--control"),
        "": _MESSAGES,
    },
    ("export",): {
        "output": ("--format", "--out"),
        "splats and clouds": ("--colors", "--time", "--point-limit"),
        "data sets": ("--with-images", "--text"),
        "trajectories and cameras": ("--refined", "--storage"),
        "depth": ("--type",),
        "": _MESSAGES,
    },
    ("demo",): {
        "output": _OUTPUT,
        "dive": ("--path", "--length", "--frames", "--width", "--height", "--family", "--moving-object", "--seed"),
        "map": ("--recipe",),
        "": _MESSAGES,
    },
    ("view",): {
        "address": ("--host", "--port"),
        "pictures": ("--moving-side", "--full-side", "--pictures-per-second", "--jpeg-quality", "--map-device"),
        "water": ("--water",),
        "": _MESSAGES,
    },
    ("bench", "flsea"): {
        "input": ("--sequences", "--stride"),
        "methods": ("--methods", "--adapters", "--imports"),
        "output": ("--out",),
        "speed and quality": ("--preset", "--jobs", "--engine"),
        "": _MESSAGES,
    },
    ("bench", "sfm"): {
        "input": ("--fps", "--long-side", "--references"),
        "methods": ("--methods", "--adapters", "--imports"),
        "output": ("--out",),
        "speed and quality": ("--preset", "--jobs", "--engine"),
        "": _MESSAGES,
    },
    ("bench", "render"): {
        "input": ("--fps", "--given-poses", "--references"),
        "methods": ("--recipes", "--against", "--poses", "--seeds"),
        "output": ("--out",),
        "speed and quality": ("--preset", "--splat.iterations", "--jobs", "--engine"),
        "": _MESSAGES,
    },
    ("bench", "localization"): {
        "input": ("--maps", "--references"),
        "methods": ("--matcher", "--weights", "--accept"),
        "output": ("--out",),
        "speed and quality": ("--jobs", "--engine"),
        "": _MESSAGES,
    },
    ("bench", "scale"): {
        "surveys": ("--counts", "--width", "--height", "--seed", "--last"),
        "output": ("--out",),
        "settings": ("--preset", "--splat.iterations"),
        "": _MESSAGES,
    },
    ("bench", "revisits"): {
        "visits": ("--water-pairs", "--path-length", "--width", "--height", "--seed"),
        "output": ("--out",),
        "settings": ("--preset",),
        "": _MESSAGES,
    },
    ("bench", "ablation-sfm"): {
        "input": ("--sequences", "--stride", "--adapters"),
        "output": ("--out",),
        "speed and quality": ("--preset", "--jobs", "--engine"),
        "": _MESSAGES,
    },
    ("bench", "ablation-uwbs"): {
        "methods": ("--seeds",),
        "output": ("--out",),
        "speed and quality": ("--preset", "--splat.iterations", "--jobs", "--engine"),
        "": _MESSAGES,
    },
}
