"""A robot as docs/how-to/robots.md describes it; its table is simulated. Needs the extra `serve`, and meshes."""

import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Response

from osfcore import AssetLibrary, SceneRequest, Tabletop, camera_to_json, default_cameras, srgb_of_linear, to_uint8

NAMES = ("005_tomato_soup_can", "009_gelatin_box")
MAX_SPEED_M_S = 0.3  # along x and along y
BOX, TOP_SPEED_M_S, DEADMAN_S, SLICES_HZ = (-0.35, -0.35, 0.35, 0.35), 0.43, 0.2, 60.0  # the table keeps the box


def robot(table: Tabletop) -> FastAPI:
    """All that a robot has to answer: replace what touches `table` by your cameras and motors."""
    app, moving, stopped = FastAPI(), threading.Lock(), threading.Event()
    stopped.set()  # until somebody starts it
    cameras = {camera.name: camera for camera in table.cameras}

    @app.get("/robot")
    def describe() -> dict:
        told = {
            "limits": {"box": BOX, "top_speed_m_s": TOP_SPEED_M_S},
            "pusher_radius_m": 0.015,
            "deadman_s": DEADMAN_S,
        }
        return {"cameras": [camera_to_json(camera) for camera in table.cameras], "masks": list(table.names)} | told

    @app.get("/pusher")
    def pusher() -> dict:
        return {"position": table.truth().pusher.tolist()}

    @app.get("/images/{name}")
    def image(name: str) -> Response:
        with moving:
            seen = table.render((cameras[name],)).images[0]
        bgr = to_uint8(srgb_of_linear(seen))[..., ::-1]
        return Response(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes(), media_type="image/jpeg")

    @app.get("/masks/{name}/{thing}")
    def mask(name: str, thing: str) -> Response:
        with moving:
            masks = table.render((cameras[name],), masks=True).masks[0]
        grey = 255 * masks[table.names.index(thing)].astype("uint8")
        return Response(cv2.imencode(".png", grey)[1].tobytes(), media_type="image/png")

    @app.post("/start", status_code=204)
    def start() -> None:
        stopped.clear()

    @app.post("/stop", status_code=204)
    def stop() -> None:
        stopped.set()  # waits for nothing: the motion looks at it

    @app.post("/act")
    def act(command: dict) -> dict:
        (x, y), seconds = command["velocity"], command["duration_s"]
        if not 0 < seconds <= DEADMAN_S or max(abs(x), abs(y)) > MAX_SPEED_M_S:
            raise HTTPException(422, f"A motion takes at most {DEADMAN_S} s, at {MAX_SPEED_M_S} m/s along x and y.")
        with moving:  # when the time is over the pusher stands, whoever has gone meanwhile
            slices = table.act_steps(np.array([x, y, 0.0]), SLICES_HZ)
            while not stopped.is_set():
                if next(slices, None) is None:
                    return pusher()
                time.sleep(1 / SLICES_HZ)
        raise HTTPException(409, "it was stopped, or not started")

    return app


if __name__ == "__main__":
    from app.storage.paths import default_data_dir

    library = AssetLibrary(Path(sys.argv[1]) if len(sys.argv) > 1 else default_data_dir() / "objects")
    world = Tabletop(library, request=SceneRequest(names=NAMES), cameras=default_cameras(256))
    world.arrange(1)
    uvicorn.run(robot(world), port=int(sys.argv[2]) if len(sys.argv) > 2 else 8080)
