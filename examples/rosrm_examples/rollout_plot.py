POSES_FILE = "poses.json"
ROLLOUT_FILE = "rollout.png"
def draw_rollout(*a): pass
