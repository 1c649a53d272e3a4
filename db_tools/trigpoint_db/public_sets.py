"""Public data sets that the importers read: their owners' pages, and their terms.

Nothing is fetched: the owners want their terms read first.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PublicSet:
    """One data set; `layout` says what to unpack where, `command` imports it then."""

    format: str
    title: str
    url: str
    terms: str
    layout: str
    command: str


PUBLIC_SETS = (
    PublicSet(
        "7scenes",
        "7-Scenes: seven rooms, a Kinect (Shotton et al., CVPR 2013)",
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
        "Microsoft Research License Agreement: non-commercial use only",
        "unzip chess.zip and in it every seq-*.zip",
        "trigpoint-db build chess.tpmap chess",
    ),
    PublicSet(
        "7scenes",
        "7-Scenes, with poses by structure from motion (Brachmann et al., ICCV 2021)",
        "https://github.com/tsattler/visloc_pseudo_gt_limitations",
        "that of 7-Scenes",
        "7-Scenes, and the folder pgt of this repository",
        "trigpoint-db build chess.tpmap chess --poses pgt/sfm/7scenes",
    ),
    PublicSet(
        "cambridge",
        "Cambridge Landmarks: six places outdoors, a phone (Kendall et al., ICCV 2015)",
        "https://www.repository.cam.ac.uk/items/53788265-cb98-42ee-b85b-7a0cbc8eddb3",
        "on the page of each scene",
        "unzip KingsCollege.zip",
        "trigpoint-db build kings.tpmap KingsCollege",
    ),
    PublicSet(
        "aachen",
        "Aachen Day-Night v1.1: an old town, queries by day and by night (Zhang et al., IJCV 2021)",
        "https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/Aachen-Day-Night/",
        "CC BY-NC-SA 4.0, LICENSE.txt there",
        "unzip images/database_and_query_images.zip, then aachen_v1_1.zip, in one folder",
        "trigpoint-db build aachen.tpmap aachen_v1.1",
    ),
    PublicSet(
        "robotcar",
        "RobotCar Seasons: a drive through Oxford in ten conditions (Sattler et al., CVPR 2018)",
        "https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/RobotCar-Seasons/",
        "LICENSE.txt there; non-commercial, as the Oxford RobotCar data set",
        "3D-models/, intrinsics/, and every zip file of images/ unpacked in images/",
        "trigpoint-db build oxford.tpmap RobotCar-Seasons",
    ),
    PublicSet(
        "tum",
        "TUM RGB-D: offices and a hall, a Kinect and motion capture (Sturm et al., IROS 2012)",
        "https://cvg.cit.tum.de/data/datasets/rgbd-dataset",
        "on that page",
        "tar xf rgbd_dataset_freiburg1_desk.tgz",
        "trigpoint-db build desk.tpmap rgbd_dataset_freiburg1_desk",
    ),
    PublicSet(
        "euroc",
        "EuRoC MAV: a drone in rooms and a machine hall (Burri et al., IJRR 2016)",
        "https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets",
        "on that page",
        "unzip V1_01_easy.zip in a folder V1_01_easy",
        "trigpoint-db build vicon.tpmap V1_01_easy",
    ),
)
