// Mouse, touch and wheel on the picture: orbit, pan, zoom; a double click sets the pivot.

import { orbit, pan, zoom } from "./camera.js";

const ZOOM_PER_PIXEL = 0.0012;  // of the wheel: a step of 100 px changes the distance by 12 %, as in the window
const TAP_MS = 300, TAP_PX = 24;

// `page` has { camera, look(camera), focal, radius, pivotAt(x, y) }.
export function listen(canvas, page) {
  const pointers = new Map();
  let tap = { time: -Infinity, x: 0, y: 0 };
  const middle = () => {
    const all = [...pointers.values()];
    const x = all.reduce((sum, p) => sum + p.x, 0) / all.length, y = all.reduce((sum, p) => sum + p.y, 0) / all.length;
    return { x, y, spread: all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0 };
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    page.touched();
  });
  canvas.addEventListener("pointermove", (event) => {
    const pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const before = middle();
    pointer.x = event.clientX;
    pointer.y = event.clientY;
    const after = middle(), dx = after.x - before.x, dy = after.y - before.y;
    let { camera } = page;
    const slides = pointers.size > 1 || event.buttons & 6 || event.shiftKey || event.ctrlKey;
    camera = slides ? pan(camera, dx, dy, page.focal) : orbit(camera, dx, dy);
    if (before.spread > 0 && after.spread > 0) camera = zoom(camera, before.spread / after.spread, page.radius);
    page.look(camera);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      if (!pointers.delete(event.pointerId) || name !== "pointerup" || pointers.size) return;
      const { offsetX: x, offsetY: y, timeStamp: time } = event;
      const again = time - tap.time < TAP_MS && Math.hypot(x - tap.x, y - tap.y) < TAP_PX;
      if (again) page.pivotAt(x, y);
      tap = { time: again ? -Infinity : time, x, y };
    });
  }
  canvas.addEventListener("wheel", (event) => {
    if (!page.takesWheel) return;
    event.preventDefault();
    const pixels = event.deltaY * [1, 33, 400][event.deltaMode];
    page.look(zoom(page.camera, Math.exp(ZOOM_PER_PIXEL * pixels * (event.ctrlKey ? 8 : 1)), page.radius));
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
}
