from mapfusion.align.acceptance import Acceptance as Acceptance
from mapfusion.align.correspondences import Correspondences as Correspondences
from mapfusion.align.correspondences import MatchParameters as MatchParameters
from mapfusion.align.correspondences import match as match
from mapfusion.align.refine import Refinement as Refinement
from mapfusion.align.registration import Aligner as Aligner
from mapfusion.align.registration import Registered as Registered
from mapfusion.align.registration import Registration as Registration
from mapfusion.align.registry import make_aligner as make_aligner
from mapfusion.align.result import Alignment as Alignment
from mapfusion.align.result import Status as Status
from mapfusion.errors import InputError as InputError
from mapfusion.fastslam.association import Association as Association
from mapfusion.fastslam.filter import FastSlam as FastSlam
from mapfusion.fastslam.filter import StepResult as StepResult
from mapfusion.fastslam.motion import MotionNoise as MotionNoise
from mapfusion.fastslam.parameters import FastSlamParameters as FastSlamParameters
from mapfusion.fastslam.proposal import Proposal as Proposal
from mapfusion.fastslam.run import build_map as build_map
from mapfusion.fastslam.run import run_log as run_log
from mapfusion.landmark_map import LandmarkMap as LandmarkMap
from mapfusion.landmark_map import read_map as read_map
from mapfusion.landmark_map import write_map as write_map
from mapfusion.merge import FusedMap as FusedMap
from mapfusion.merge import MergeParameters as MergeParameters
from mapfusion.merge import merge as _merge
from mapfusion.recordings.registry import import_recording as import_recording
from mapfusion.robot_log import Observations as Observations
from mapfusion.robot_log import RobotLog as RobotLog
from mapfusion.robot_log import read_log as read_log
from mapfusion.robot_log import write_log as write_log

merge_maps = _merge  # `merge` is the module
__version__: str
