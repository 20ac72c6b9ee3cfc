"""What each topic and service of the graph means, in one or two sentences for the interface page."""

from __future__ import annotations

MEANINGS = {
    "/clicked_point": "RViz's *Publish Point*; answered on `clicked_surface` and `query_status`.",
    "/diagnostics": "Once a second: the node's state, age of scan and field, requests, refusals and times of each "
    "service, the last error. The planner's are signs of life for the arm.",
    "/tf": "The end effector in the robot's base, from `ee_pose` and with its stamp; parameter `transforms.moving`.",
    "/tf_static": "The OCT frame and the laser frame in the end effector's, from the calibration; `oct_bscan_frame`, "
    "the image frame of B-scan 0, in the OCT frame.",
    "abort": "Laser off and arm stopped within one control period; the staged plan is dropped, the laser disabled.",
    "band": "The points whose intensity lies in the band: x, y, z, intensity, in the OCT frame; published again when a "
    "field or a limit changes, empty where a new field has none.",
    "bscan": "One B-scan: `mono8`, `mono16` or `32FC1`, rows are axial, columns lateral, either endianness, rows may "
    "be padded; stamped with its own acquisition time, frame `oct_bscan_frame`.",
    "bscan_pose": "The pose of that image's frame in the OCT frame, of equal stamp: y tells index and spacing; y = 0 "
    "begins a C-scan.",
    "cancel": "Gives the running fit up, and the C-scan that waits for it; the last field stays.",
    "clicked_surface": "The surface under the clicked point, along the beam, in the frame of the click.",
    "ee_pose": "The end effector in the robot's base, at acquisition time, 10 Hz or more; without it there are no "
    "waypoints in the base.",
    "enable_laser": "The interlock: without it nothing fires; false turns the laser off at once and aborts.",
    "enface": "The C-scan seen along the beam, as a map in the OCT frame, 101 grey levels.",
    "execute": "Fires the staged plan: of the present scan, young enough, the one that one living planner stands for, "
    "laser enabled; or it is refused with the reason.",
    "execution_status": "State of the arm (`idle`, `staged`, `executing`, `done`, `aborted`, ...), shots, depth "
    "removed, error between planned and actual spot.",
    "field": "The field itself, float16, format `octn-field/safetensors`, stamped with the scan: first the one through "
    "the measured voxels, then the fitted one in its place.",
    "fit_progress": "A report a few times a second while a fit runs; the C-scan that was refused, and why.",
    "laser_on": "Whether the laser fires, or has fired in the last control step; published when it changes.",
    "load_cscan": "`map_url`: a path or file:// URL below the parameter `data_root`. The file is fitted as a C-scan "
    "is; answered with its `enface` view, or an error code and the reason on `fit_progress`.",
    "path": "The plan for the eyes, in the base, or in the end-effector frame where the arm's pose is not known.",
    "plan_markers": "The same as lines coloured by confidence, grey where the laser is off, red dots where a waypoint "
    "was given up.",
    "plan_preview": "A picture of the plan over the en-face view, to be looked at before `execute`; `rgb8`.",
    "plan_raster": "Start and goal are opposite corners of a rectangle, the start's yaw its angle, in any frame of the "
    "calibration; tolerance the line spacing in metres, 0 = the parameter. Answered with the path in the end-effector "
    "frame, empty when refused.",
    "plan_status": "The plan that stands, by hash, and its field (kind, stamp, hash): without that nothing fires it "
    "(connecting.md); method, tau, hit rate, smoothness, residuals, error budget, times; or the reason in words.",
    "query_band": "Publishes `band` now, and says how many points it has.",
    "query_intensity": "The answer: x, y, z, intensity, gx, gy, gz, in the frame, stamp and order of the question; NaN "
    "outside the scan.",
    "query_points": "Any cloud with x, y, z, in any frame of the calibration; in the field's own alone where that is "
    "another scanner's.",
    "query_slice": "`map_url`: `bscan:128.5`, `enface:mip`, `plane:...` (queries.md). Answered as a map placed in "
    "space, 101 grey levels; in full depth on `slice`.",
    "query_status": "What was asked last and how it went; the figures of a clicked point.",
    "query_surface": "A line from start to goal, sampled every `tolerance` metres: poses on the surface, z along the "
    "inward normal, in the OCT frame; empty when refused.",
    "refit": "Fits the newest C-scan again, with the present parameters.",
    "removed_depth": "The truth that only a simulator knows: metres gone at each A-scan; `32FC1`.",
    "replan": "Plans over the region of the parameters `region.*`: a centred rectangle of 3 by 3 mm by default.",
    "scan": "Drives the arm to its scanning pose and plays one C-scan.",
    "scan_ee_pose": "Where the end effector was at the scan; stamped with it.",
    "slice": "The last slice that was asked for; `32FC1`, NaN outside the scan.",
    "surface": "The tissue surface under each A-scan of a lattice: x, y, z, intensity, confidence, in the OCT frame; "
    "empty where a field has none.",
    "tissue_motion": "How far the tissue has moved since the last scan, as a tracker would measure it, in the OCT "
    "frame.",
    "tool_path": "What poses cannot say of each waypoint: position, quaternion, segment, laser on or off, speed, "
    "residual, confidence.",
    "waypoints": "Poses of the laser's focus in the end-effector frame at the time of the scan; empty: the plan is "
    "withdrawn.",
    "waypoints_base": "The same in the robot's base: where to go, wherever the arm is now.",
    "waypoints_oct": "The same in the OCT frame at the time of the scan.",
}  # fmt: skip
