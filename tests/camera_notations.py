"""One camera as the tools of other people write it, and files that must be refused."""

# ruff: noqa: E501 - rows of text as it stands in files

from __future__ import annotations

import json

import numpy as np

SIZE = (752, 480)
INTRINSICS = (458.654, 457.296, 367.215, 248.375)
FX, FY, CX, CY = INTRINSICS
MATRIX = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]
ROW_MATRIX = [value for row in MATRIX for value in row]
COLUMN_MATRIX = np.array(MATRIX).T.ravel().tolist()
BROWN = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
BROWN5 = (*BROWN, 0.0125)
BROWN8 = (*BROWN5, 0.011, -0.002, 0.0003)
FISHEYE = (0.01, -0.02, 0.003, 0.0004)

K1_K2_P1_P2 = "{0}k1: -0.28340811\n{0}k2: 0.07395907\n{0}p1: 0.00019359\n{0}p2: 1.76187114e-05\n"
K1_TO_K4 = "{0}k1: 0.01\n{0}k2: -0.02\n{0}k3: 0.003\n{0}k4: 0.0004\n"
FX_TO_CY = "{0}fx: 458.654\n{0}fy: 457.296\n{0}cx: 367.215\n{0}cy: 248.375\n"
K = f"camera_matrix: {MATRIX}\n"
FILE_STORAGE = f"""%YAML:1.0
---
calibration_time: "Sat 01 Aug 2026 10:00:00"
nframes: 20
image_width: 752
image_height: 480
board_width: 9
board_height: 6
square_size: 2.5e-02
flags: 0
fisheye_model: {{fisheye}}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {ROW_MATRIX}
distortion_coefficients: !!opencv-matrix
   rows: {{count}}
   cols: 1
   dt: d
   data: {{distortion}}
avg_reprojection_error: 2.9e-01
per_view_reprojection_errors: !!opencv-matrix
   rows: 4
   cols: 1
   dt: f
   data: [ 0.1, 0.2, 0.3, 0.4 ]
"""
BASALT = {
    "value0": {
        "T_imu_cam": [{"px": 0.1, "py": 0, "pz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}],
        "intrinsics": [
            {
                "camera_type": "kb4",
                "intrinsics": {
                    "fx": FX,
                    "fy": FY,
                    "cx": CX,
                    "cy": CY,
                    "k1": 0.01,
                    "k2": -0.02,
                    "k3": 0.003,
                    "k4": 0.0004,
                },
            }
        ],
        "resolution": [[752, 480]],
        "calib_accel_bias": [0.1, 0.2, 0.3, 0, 0, 0, 0, 0, 0],
    }
}
GYROFLOW = {
    "name": "GoPro_HERO9 Black_Wide",
    "camera_brand": "GoPro",
    "camera_model": "HERO9 Black",
    "lens_model": "Wide",
    "calib_dimension": {"w": 752, "h": 480},
    "orig_dimension": {"w": 752, "h": 480},
    "input_horizontal_stretch": 1.0,
    "fps": 59.94,
    "fisheye_params": {"RMS_error": 0.4, "camera_matrix": MATRIX, "distortion_coeffs": list(FISHEYE)},
}
OAK = {
    "boardName": "OAK-D",
    "cameraData": [
        [0, {"cameraType": 0, "distortionCoeff": [*BROWN8, 0, 0, 0, 0, 0, 0], "height": 480, "intrinsicMatrix": MATRIX,
             "lensPosition": 135, "specHfovDeg": 69.0, "width": 752}],
        [1, {"cameraType": 1, "distortionCoeff": [*FISHEYE, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], "height": 480,
             "intrinsicMatrix": MATRIX, "width": 752}],
    ],
}  # fmt: skip
ZED = """[LEFT_CAM_2K]
fx=1400
fy=1400
cx=1104
cy=621
k1=-0.17
k2=0.02
k3=0
p1=0
p2=0

[LEFT_CAM_HD]
fx=458.654
fy=457.296
cx=367.215
cy=248.375
k1=-0.28340811
k2=0.07395907
k3=0.0125
p1=0.00019359
p2=1.76187114e-05

[STEREO]
Baseline=119.9
"""
MATLAB = {
    "RadialDistortion": [BROWN[0], BROWN[1]],
    "TangentialDistortion": [BROWN[2], BROWN[3]],
    "ImageSize": [480, 752],
    "IntrinsicMatrix": [[FX, 0, 0], [0, FY, 0], [CX + 1, CY + 1, 1]],
    "WorldUnits": "mm",
}
METASHAPE = f"""<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>752</width>
  <height>480</height>
  <f>{FY}</f>
  <cx>{CX + 0.5 - 376}</cx>
  <cy>{CY + 0.5 - 240}</cy>
  <b1>{FX - FY}</b1>
  <k1>{BROWN[0]}</k1>
  <k2>{BROWN[1]}</k2>
  <k3>{BROWN5[4]}</k3>
  <p1>{BROWN[3]}</p1>
  <p2>{BROWN[2]}</p2>
  <date>2026-08-01T10:00:00Z</date>
</calibration>
"""
OPENCV_XML = f"""<?xml version="1.0"?>
<opencv_storage>
<image_Width>752</image_Width>
<image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>{" ".join(map(repr, ROW_MATRIX))}</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
<data>{" ".join(map(repr, BROWN5))}</data></Distortion_Coefficients>
</opencv_storage>
"""
KITTI_RAW = f"""calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 1392 512
K_00: 980 0 690 0 970 245 0 0 1
D_00: -0.37 0.2 0.001 0.002 -0.07
R_00: 1 0 0 0 1 0 0 0 1
T_00: 0 0 0
S_rect_00: 752 480
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: {FX} 0 {CX} 0 0 {FY} {CY} 0 0 0 1 0
"""
MRPT = """[CAMERA_PARAMS]
resolution = [752 480]
cx = 367.215
cy = 248.375
fx = 458.654
fy = 457.296
dist = [-0.28340811 0.07395907 0.00019359 1.76187114e-05 0.0125]
distortion = plumb_bob
focal_length = 0.0028
pose_quaternion = [0 0 0 1 0 0 0]
"""
ROS_ROI = f"""height: 960
width: 1504
distortion_model: plumb_bob
d: {list(BROWN5)}
k: [{2 * FX}, 0, {2 * CX + 0.5}, 0, {2 * FY}, {2 * CY + 0.5}, 0, 0, 1]
binning_x: 2
binning_y: 2
roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}}
"""

# name of the file, content, distortion, model, whether the size is in it
READ: list[tuple[str, str, tuple[float, ...], str, bool]] = [
    ("flat.yaml", FX_TO_CY.format("") + K1_K2_P1_P2.format(""), BROWN, "brown", False),
    ("flat_fisheye.yaml", FX_TO_CY.format("") + K1_TO_K4.format("") + "model: fisheye\n", FISHEYE, "fisheye", False),
    ("dist_coeff.yaml", K + f"dist_coeff: [{list(BROWN5)}]\n", BROWN5, "brown", False),
    ("dist_coeffs.json", json.dumps({"mtx": MATRIX, "dist": [list(BROWN5)]}), BROWN5, "brown", False),
    ("distCoeffs.json", json.dumps({"cameraMatrix": MATRIX, "distCoeffs": [list(BROWN8)]}), BROWN8, "brown", False),
    ("opencv.yml", FILE_STORAGE.format(fisheye=0, count=5, distortion=list(BROWN5)), BROWN5, "brown", True),
    ("opencv_fisheye.yml", FILE_STORAGE.format(fisheye=1, count=4, distortion=list(FISHEYE)), FISHEYE, "fisheye", True),
    ("opencv.xml", OPENCV_XML, BROWN5, "brown", True),
    ("no_space.yaml", FX_TO_CY.format("").replace(": ", ":") + "k1:-0.1\nk2:0\np1:0\np2:0\n", (-0.1, 0, 0, 0), "brown", False),
    ("orbslam2.yaml", "%YAML:1.0\n" + FX_TO_CY.format("Camera.") + K1_K2_P1_P2.format("Camera.") + "Camera.k3: 0.0125\n"
     "Camera.fps: 30.0\nCamera.bf: 40.0\nCamera.RGB: 1\nThDepth: 40.0\nDepthMapFactor: 5000.0\nORBextractor.nLevels: 8\n"
     "ORBextractor.scaleFactor: 1.2\nViewer.KeyFrameSize: 0.05\nViewer.CameraSize: 0.08\n", BROWN5, "brown", False),
    ("orbslam3.yaml", "%YAML:1.0\nFile.version: \"1.0\"\nCamera.type: \"PinHole\"\n" + FX_TO_CY.format("Camera1.")
     + K1_K2_P1_P2.format("Camera1.") + "Camera.width: 752\nCamera.height: 480\nCamera.newWidth: 600\n"
     "Camera.newHeight: 350\nCamera.fps: 20\nCamera.RGB: 1\nIMU.NoiseGyro: 1.7e-4\n", BROWN, "brown", True),
    ("orbslam3_tumvi.yaml", "%YAML:1.0\nCamera.type: \"KannalaBrandt8\"\n" + FX_TO_CY.format("Camera.")
     + K1_TO_K4.format("Camera.") + "Camera.width: 752\nCamera.height: 480\n", FISHEYE, "fisheye", True),
    ("stella.yaml", "Camera:\n  name: \"x\"\n  setup: \"monocular\"\n  model: \"perspective\"\n" + FX_TO_CY.format("  ")
     + K1_K2_P1_P2.format("  ") + "  k3: 0.0125\n  fps: 30.0\n  cols: 752\n  rows: 480\n  color_order: \"RGB\"\n"
     "Feature:\n  scale_factor: 1.2\n", BROWN5, "brown", True),
    ("stella_fisheye.yaml", "Camera:\n  model: \"fisheye\"\n" + FX_TO_CY.format("  ") + K1_TO_K4.format("  ")
     + "  cols: 752\n  rows: 480\n", FISHEYE, "fisheye", True),
    ("vins.yaml", "%YAML:1.0\nmodel_type: PINHOLE\ncamera_name: camera\nimage_width: 752\nimage_height: 480\nfisheye: 1\n"
     "distortion_parameters:\n" + K1_K2_P1_P2.format("   ") + "projection_parameters:\n" + FX_TO_CY.format("   "),
     BROWN, "brown", True),
    ("gvins_kb.yaml", "%YAML:1.0\nmodel_type: KANNALA_BRANDT\nimage_width: 752\nimage_height: 480\n"
     "projection_parameters:\n   k2: 0.01\n   k3: -0.02\n   k4: 0.003\n   k5: 0.0004\n   mu: 458.654\n   mv: 457.296\n"
     "   u0: 367.215\n   v0: 248.375\n", FISHEYE, "fisheye", True),
    ("kalibr.yaml", f"cam0:\n  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: {list(FISHEYE)}\n"
     f"  distortion_model: equidistant\n  intrinsics: {list(INTRINSICS)}\n  resolution: [752, 480]\n  rostopic: /a\n"
     "  T_cam_imu:\n  - [1, 0, 0, 0]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n  timeshift_cam_imu: 0.01\n",
     FISHEYE, "fisheye", True),
    ("ros2.yaml", f"header:\n  stamp:\n    sec: 5\n    nanosec: 7\n  frame_id: cam\nheight: 480\nwidth: 752\n"
     f"distortion_model: plumb_bob\nd:\n- {BROWN[0]}\n- {BROWN[1]}\n- {BROWN[2]}\n- {BROWN[3]}\n- 0.0125\nk: {ROW_MATRIX}\n"
     f"r: [1, 0, 0, 0, 1, 0, 0, 0, 1]\np: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]\nbinning_x: 0\nbinning_y: 0\nroi:\n"
     "  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: false\n---\n", BROWN5, "brown", True),
    ("ros_rational.yaml", f"image_width: 752\nimage_height: 480\ncamera_name: x\n{K}distortion_model: rational_polynomial\n"
     f"distortion_coefficients: {{rows: 1, cols: 8, data: {list(BROWN8)}}}\n"
     "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n", BROWN8, "brown", True),
    ("ros_roi.yaml", ROS_ROI, BROWN5, "brown", True),
    ("basalt.json", json.dumps(BASALT), FISHEYE, "fisheye", True),
    ("gyroflow.json", json.dumps(GYROFLOW), FISHEYE, "fisheye", True),
    ("oak.json", json.dumps(OAK), BROWN8, "brown", True),
    ("oak.json#cam1", json.dumps(OAK), FISHEYE, "fisheye", True),
    ("SN1234.conf#LEFT_CAM_HD", ZED, BROWN5, "brown", False),
    ("matlab.json", json.dumps(MATLAB), BROWN, "brown", True),
    ("metashape.xml", METASHAPE, BROWN5, "brown", True),
    ("mrpt.ini", MRPT, BROWN5, "brown", True),
    ("open3d.json", json.dumps({"width": 752, "height": 480, "intrinsic_matrix": COLUMN_MATRIX}), (), "brown", True),
    ("arkit.json", json.dumps({"intrinsics": [[FX, 0, 0], [0, FY, 0], [CX, CY, 1]]}), (), "brown", False),
    ("realsense.json", json.dumps({"width": 752, "height": 480, "fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "coeffs":
     [0, 0, 0, 0, 0], "model": "distortion.inverse_brown_conrady"}), (0,) * 5, "brown", True),
    ("nerfstudio.json", json.dumps({"w": 752, "h": 480, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5,
     "camera_model": "OPENCV", "k1": BROWN[0], "k2": BROWN[1], "p1": BROWN[2], "p2": BROWN[3], "aabb_scale": 16,
     "frames": []}), BROWN, "brown", True),
    ("ngp.json", json.dumps({"w": 752, "h": 480, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5, "k1": 0.01,
     "k2": -0.02, "k3": 0.003, "k4": 0.0004, "is_fisheye": True}), FISHEYE, "fisheye", True),
    ("params.json", json.dumps({"w": 752, "h": 480, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5,
     "distortion_params": [BROWN[0], BROWN[1], 0.0125, 0, BROWN[2], BROWN[3]]}), BROWN5, "brown", True),
    ("svo.yaml", "cameras:\n- camera:\n    label: cam0\n    image_height: 480\n    image_width: 752\n    type: pinhole\n    intrinsics:\n"
     f"      cols: 1\n      rows: 4\n      data: {list(INTRINSICS)}\n    distortion:\n      type: radial-tangential\n"
     f"      parameters:\n        cols: 1\n        rows: 4\n        data: {list(BROWN)}\n  T_B_C: {{cols: 4, rows: 4, data: "
     "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n", BROWN, "brown", True),
    ("fast_livo.yaml", f"cam_model: Pinhole\ncam_width: 752\ncam_height: 480\nscale: 1.0\ncam_fx: {FX}\ncam_fy: {FY}\n"
     f"cam_cx: {CX}\ncam_cy: {CY}\ncam_d0: {BROWN[0]}\ncam_d1: {BROWN[1]}\ncam_d2: {BROWN[2]}\ncam_d3: {BROWN[3]}\n", BROWN, "brown", True),
    ("mast3r.yaml", f"use_calib: True\nwidth: 752\nheight: 480\ncalibration: {[*INTRINSICS, *BROWN5]}\n", BROWN5, "brown", True),
    ("r3live.yaml", f"r3live_vio:\n   image_width: 752\n   image_height: 480\n   camera_intrinsic: {ROW_MATRIX}\n"
     f"   camera_dist_coeffs: {list(BROWN5)}\n   camera_ext_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", BROWN5, "brown", True),
    ("nice_slam.yaml", f"cam:\n  H: 480\n  W: 752\n  fx: {FX}\n  fy: {FY}\n  cx: {CX}\n  cy: {CY}\n  png_depth_scale: 6553.5\n"
     "  crop_edge: 8\n", (), "brown", True),
    ("assignments.txt", FX_TO_CY.format("").replace(":", " =") + K1_K2_P1_P2.format("").replace(":", " ="), BROWN, "brown", False),
    ("dso_radtan.txt", f"RadTan {FX} {FY} {CX} {CY} {' '.join(map(str, BROWN))}\n752 480\ncrop\n640 480\n", BROWN, "brown", True),
    ("dso_plain.txt", f"{FX} {FY} {CX} {CY} 0.9\n752 480\ncrop\n640 480\n", (0.9,), "fov", True),
    ("dso_relative.txt", f"{FX / 752!r} {FY / 480!r} {(CX + 0.5) / 752!r} {(CY + 0.5) / 480!r} 0.9\n752 480\nnone\n",
     (0.9,), "fov", True),
    ("dso_equi.txt", f"EquiDistant {FX} {FY} {CX} {CY} {' '.join(map(str, FISHEYE))}\n752 480\nfull\n640 480\n",
     FISHEYE, "fisheye", True),
    ("dpvo.txt", f"{FX} {FY} {CX} {CY} {' '.join(map(str, BROWN))}\n", BROWN, "brown", False),
    ("droid.txt", f"{FX} {FY} {CX} {CY}", (), "brown", False),
    ("calib.txt", f"P0: {FX} 0 {CX} 0 0 {FY} {CY} 0 0 0 1 0\nP1: 1 0 1 -3 0 1 1 0 0 0 1 0\n", (), "brown", False),
    ("calib_cam_to_cam.txt", KITTI_RAW, (), "brown", True),
    ("K.txt", "\n".join(" ".join(map(repr, row)) for row in MATRIX), (), "brown", False),
    ("camera_matrix.csv", "\n".join(",".join(map(repr, row)) for row in MATRIX), (), "brown", False),
]  # fmt: skip

# content, and what the message must name
REFUSED: list[tuple[str, str]] = [
    (K + "distortoin: [-0.3, 0.08, 0, 0]\n", "distortoin"),
    (K + "dist_cofs: [-0.3, 0.08, 0, 0, 0]\n", "dist_cofs"),
    (K + "lens: [-0.3, 0.08, 0, 0, 0]\n", "lens"),
    (K + "numbers: [-0.3, 0.08, 0, 0, 0]\n", "numbers"),
    (K + "distortion: [-0.3, 0.08, 0, 0]\ndist: [-0.2, 0.08, 0, 0]\n", "dist"),
    (K + "image_heigth: 480\n", "image_heigth"),
    (K + "img_size_px: 480\nraw_size: [752, 480]\nimageDims: 3\nlens_model: pincushion\n", "lens_model"),
    (FX_TO_CY.format("") + "k_1: -0.3\nk_2: 0.1\nk_7: 0.2\n", "k_7"),
    (FX_TO_CY.format("") + "s1: 0.1\n", "s1"),
    (FX_TO_CY.format("") + "k1: 0.1\nk2: 0.1\nk3: 0.1\nk4: 0.1\n", "k4"),
    (FX_TO_CY.format("") + "skew: 0.5\n", "skew"),
    (FX_TO_CY.format("") + "xi: 1.2\n", "xi"),
    (FX_TO_CY.format("") + "distortion: [0.01, -0.02, 0.01]\n", "3 distortion coefficients"),
    (FX_TO_CY.format("") + "distortion: [1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 0, 0]\n", "thin prism"),
    (FX_TO_CY.format("") + "distortion_model: omni\n", "omni"),
    (FX_TO_CY.format("") + "camera_model: ds\n", "ds"),
    (FX_TO_CY.format("") + "distortion_model: plumb_bob\nfisheye_model: 1\n", "fisheye_model"),
    (FX_TO_CY.format("").replace("458.654", "'458,654'"), "decimal point"),
    (FX_TO_CY.format("").replace("458.654", "0.61").replace("457.296", "0.95") + "width: 752\nheight: 480\n", "relative"),
    (FX_TO_CY.format("").replace("457.296", "5"), "too different"),
    (f"cam0:\n  camera_model: omni\n  intrinsics: [1.2, {FX}, {FY}, {CX}, {CY}]\n", "5 numbers"),
    ("%YAML:1.0\nmodel_type: MEI\nmirror_parameters:\n   xi: 1.9\nprojection_parameters:\n   gamma1: 5\n", "MEI"),
    (f"Camera:\n  model: equirectangular\n{FX_TO_CY.format('  ')}", "equirectangular"),
    (f"Camera:\n{FX_TO_CY.format('  ')}  distorsion: [1, 2, 3, 4]\n", "distorsion"),
    ("camera_matrix: [[400, 0.5, 376], [0, 400, 240], [0, 0, 1]]\n", "skew"),
    ("camera_matrix: [[400, 0, 376], [0, 400, 240], [0, 0, 2]]\n", "last row"),
    (f"fx: 400\n{K}", "fx"),
    ("width: 752\nheight: 480\nfx: 400\nfy: 400\ncx: 376\ncy: 240\nimage_width: 640\nimage_height: 480\n", "640x480"),
]  # fmt: skip
