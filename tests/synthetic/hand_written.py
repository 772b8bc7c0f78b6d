"""Files of formats that are read and not written."""

CALISCOPE = """[cameras.0]
cam_id = 0
size = [1280, 720]
matrix = [[900.0, 0.0, 640.0], [0.0, 901.0, 360.0], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.1, 0.001, 0.002, 0.0]
translation = [0.0, 0.0, 0.0]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
[cameras.1]
cam_id = 1
size = [1280, 720]
matrix = [[900.0, 0.0, 640.0], [0.0, 901.0, 360.0], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.1, 0.001, 0.002]
fisheye = true
translation = [0.1, 0.2, 0.3]
rotation = [0.1, -0.2, 0.3]
"""

QUALISYS = """<?xml version='1.0'?>
<calibration type="regular"><cameras>
<camera serial="one">
<fov_video left="0" top="0" right="1087" bottom="1919"/>
<transform x="1000" y="0" z="2000" r11="0" r12="1" r13="0" r21="0" r22="0" r23="1"
 r31="1" r32="0" r33="0"/>
<intrinsic focalLengthU="64000" focalLengthV="64640" centerPointU="32000" centerPointV="60800"
 skew="0" radialDistortion1="-0.05" radialDistortion2="0.1" radialDistortion3="0"
 tangentalDistortion1="0.001" tangentalDistortion2="0.002" sensorMaxU="69568" sensorMaxV="122816"/>
</camera></cameras></calibration>
"""

KITTI = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1 0\n"

COLMAP_CAMERAS = """# Camera list
1 OPENCV 640 480 520 529 330.5 231.5 -0.31 0.11 0.004 -0.007
2 RADIAL_FISHEYE 640 480 300 330.5 231.5 -0.03 0.01
"""
COLMAP_RIGS = "1 2 CAMERA 1 CAMERA 2 1 0.998 0.01 -0.02 0.03 -0.1 0.004 0.007\n"
