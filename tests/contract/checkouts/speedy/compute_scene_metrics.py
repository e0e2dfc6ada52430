"""Metrics of a scene."""


def scene_metrics(iteration, name, cameras, scene, renderFunc, renderArgs):
    print(f"\n[ITER {iteration}] Evaluation {name}: {len(cameras)} views")
