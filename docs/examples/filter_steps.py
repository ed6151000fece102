"""The filter step by step.

One robot drives a circle twice among numbered posts. A step of the filter is one frame: predict,
associate, update, weigh, resample. The effective sample size is that of the weights before
resampling. The spread is the standard deviation of the particles' positions around their mean; it
grows in new territory and falls where the circle closes.
"""

import matplotlib.pyplot as plt
import numpy as np

import mapfusion
from mapfusion.geometry import se2

rng = np.random.default_rng(4)
posts_m = rng.uniform([-7, -3], [7, 11], (60, 2))
increment, sigma = np.array([0.4, 0.0, 0.1]), np.array([0.02, 0.01, 0.01])
settings = mapfusion.FastSlamParameters(
    n_particles=200,
    planar=True,
    proposal=mapfusion.Proposal.MOTION,
    association=mapfusion.Association.LABEL,
)
slam = mapfusion.FastSlam(settings, rng)

pose, true_path, spread_m, effective, clouds = np.zeros(3), [], [], [], {}
for k in range(126):
    odometry = np.zeros(3)
    if k:
        pose = se2.compose(pose, increment)
        odometry = increment + rng.normal(0, sigma)
    ahead_m = se2.transform_points(se2.inverse(pose), posts_m)
    seen = np.flatnonzero((np.hypot(*ahead_m.T) < 3) & (ahead_m[:, 0] > 0))
    position_m = np.zeros((len(seen), 3))
    position_m[:, :2] = ahead_m[seen] + rng.normal(0, 0.1, (len(seen), 2))
    covariance_m2 = np.tile(np.eye(3) * 0.1**2, (len(seen), 1, 1))
    observations = mapfusion.Observations(position_m, covariance_m2, label=seen)

    result = slam.step(odometry, observations, sigma if k else np.zeros(3))
    true_path.append(pose)
    weights = np.exp(result.log_weights)
    mean_m = weights @ result.cloud[:, :2]
    spread_m.append(np.sqrt(weights @ np.sum((result.cloud[:, :2] - mean_m) ** 2, axis=1)))
    effective.append(result.effective_sample_size)
    if k % 25 == 0:
        if 0 < k < 125:
            clouds[k] = result.cloud
        print(
            f"frame {k:3}: {result.n_landmarks:2} landmarks, effective sample size "
            f"{effective[-1]:5.1f}, spread {spread_m[-1]:.3f} m, resampled: {result.resampled}"
        )

figure, (plan, over_time) = plt.subplots(1, 2, figsize=(11, 5), layout="constrained")
plan.plot(*np.array(true_path)[:, :2].T, "k:", label="true path")
plan.plot(*slam.best_path()[:, :2].T, label="path of the best particle")
for k, cloud in clouds.items():
    plan.plot(*cloud[:, :2].T, ".", markersize=2, color="tab:red")
    plan.annotate(f"{k}", cloud[:, :2].mean(axis=0), xytext=(5, 5), textcoords="offset points")
plan.plot(*slam.best_map().position_m[:, :2].T, "+", color="tab:green", label="landmarks")
plan.set(xlabel="x [m]", ylabel="y [m]", ylim=(-3, 14), aspect="equal", title="Map and particles")
plan.legend(loc="upper left")
over_time.plot(effective, label="effective sample size")
over_time.set(xlabel="frame", ylabel="effective sample size")
spread = over_time.twinx()
spread.plot(spread_m, color="tab:red")
spread.set_ylabel("spread of the particles [m]", color="tab:red")
over_time.set_title("Weights, and spread of the particles")
figure.savefig("picture.png", dpi=100)
