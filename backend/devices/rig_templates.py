"""Rig files to begin with: complete, with a word on every entry; what has to be replaced is marked."""

_ENTRIES = """\
# reference: right         # the camera whose pixels are measured; without this line the first
# snap_exposures: false    # for displays whose light is steady: exposures needn't be whole frame periods
# calibration: stereo.yaml # or: unglare rigs calibration --rig NAME FILE; without one scans end with the phase
"""

_SENSOR = """\
    sensor:                       # from the camera's data sheet (EMVA 1288): the noise that checks expect
      full_well_e: 10500          # electrons at full scale, at gain 0 dB
      read_noise_e: 6.5
"""

STEREO_PAGE = f"""\
# Two GigE Vision cameras and a projector (or a screen) as second monitor.
#   unglare rigs add FILE --name bench     checks this file and keeps it
#   unglare rigs check --rig bench         opens it and takes a picture with each camera
#   unglare rigs latency --rig bench       measures how late the projector is; before the first scan
title: Bench
cameras:
  left:
    driver: aravis                # unglare drivers lists what there is, unglare drivers aravis what it takes
    address: 192.168.10.2         # <- REPLACE: its IPv4 address; or serial: NUMBER (USB3 Vision)
{_SENSOR}\
    # limits: {{longest_exposure_ms: 500, largest_gain_db: 12}}  # what it shall not be used beyond
  right:
    driver: aravis
    address: 192.168.10.3         # <- REPLACE
{_SENSOR}\
projector:
  driver: page                    # a browser window on the projector's monitor: unglare projector
  size: 1280x800                  # <- REPLACE: pixels of that monitor; patterns are never scaled
  # gamma: 2.2                    # of a display that isn't linear
{_ENTRIES}"""

LIGHTCRAFTER = f"""\
# One GigE Vision camera on the trigger line of a DLP LightCrafter 4500 (experimental).
#   unglare patterns export                writes the pattern set for its flash
title: LightCrafter
cameras:
  top:
    driver: aravis
    address: 192.168.10.2         # <- REPLACE
    trigger_line: Line1           # <- REPLACE: the input that TRIG_OUT_1 drives; without it: software triggers
{_SENSOR}\
projector:
  driver: dlpc350                 # unglare drivers dlpc350 tells all options
  patterns: ~/patterns            # <- REPLACE: folder of the exported pattern set that its flash holds
{_ENTRIES}"""

WEBCAM = f"""\
# A webcam and this computer's second monitor: to try things out, not to measure.
title: Webcam
cameras:
  webcam:
    driver: video
    source: 0                     # <- REPLACE: 0 is /dev/video0
    # size: 1280x720
    # exposure_us: 33000          # of a webcam that doesn't tell its exposure
projector:
  driver: page
  size: 1920x1080                 # <- REPLACE: pixels of the monitor
  gamma: 2.2
{_ENTRIES}"""

MIRROR_PAGE = f"""\
# One camera that sees this computer's second monitor in a mirror: unglare scan --rig NAME --method fringe-reflection
title: Mirrors
cameras:
  camera:
    driver: aravis
    address: 192.168.10.2         # <- REPLACE
{_SENSOR}\
projector:
  driver: page                    # the monitor is the screen: a browser window on it, unglare projector
  size: 1920x1080                 # <- REPLACE: pixels of that monitor; patterns are never scaled
snap_exposures: true              # whole frames of the monitor; false where its backlight is steady
# Without a calibration scans end with the places on the screen. Poses are x_device = R x_world + t_mm, the world is the
# camera's frame: +X right, +Y down, +Z forward, mm.
calibration:
  cameras:
    camera:                       # <- REPLACE: as OpenCV calibrates it, at the size of its pictures
      width_px: 1280
      height_px: 1024
      K: [[3712, 0, 640], [0, 3712, 512], [0, 0, 1]]
      distortion: [0, 0, 0, 0, 0]
  screen:                         # <- REPLACE: +X right and +Y down as its viewer sees it, +Z away from him; origin in its middle
    width_px: 1920
    height_px: 1080
    pixel_pitch_mm: 0.2767        # from its data sheet; of a bent one `points: [[x, y in 0..1 of the pattern, x, y, z in mm], ...]`
    R: [[-1, 0, 0], [0, 0.866025, 0.5], [0, 0.5, -0.866025]]
    t_mm: [0, -100, 200]          # where the camera is in the screen's frame
  # mirror: {{R: [[1, 0, 0], [0, -1, 0], [0, 0, -1]], t_mm: [0, 0, 700]}}  # if it always lies there; else its outline tells
"""

TEMPLATES = {
    "stereo-page": STEREO_PAGE,
    "mirror-page": MIRROR_PAGE,
    "lightcrafter": LIGHTCRAFTER,
    "webcam": WEBCAM,
}
"""Text by name."""
