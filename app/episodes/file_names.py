"""Names of what an episode leaves in its folder."""

REPORT_FILE, CSV_FILE, VIDEO_FILE, RECORDING_FILE = "report.json", "steps.csv", "video.mp4", "episode.viser"
GOAL_FILE, FRAMES_FOLDER = "goal.png", "frames"
CAMERAS_FOLDER = "cameras"  # what the cameras of a robot saw last
STOPPED = "stopped"  # the outcome in the report of an episode with a robot that was broken off
ARCHIVE_FILE = "episode.zip"  # all that can be downloaded, made on demand
TRAJECTORY_FILE = "trajectory.npz"
PREPARED_FILE = "prepared.json"  # what was found out beforehand about an example
CLIP_FILE = "clip.mp4"  # to be posted, made on demand
