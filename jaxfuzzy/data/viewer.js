// Runs inside the 3D view's own frame; the page outside speaks to it by messages. META comes from page.py.
const world = K3DInstance.getWorld();
const events = K3DInstance.events;
let camera = META.front.slice();

function object(id) { return K3DInstance.getObjectById(id); }

function look(places) {
  camera = places.slice();
  K3DInstance.setCamera(camera);
  K3DInstance.render();
}

function select(index) {
  for (const [id, number] of Object.entries(META.models)) {
    const mesh = object(id);
    if (!mesh) continue;
    mesh.material.opacity = index === null ? 0.75 : number === index ? 1 : 0.25;
    mesh.material.needsUpdate = true;
  }
  K3DInstance.render();
}

function show(what, on) {
  for (const id of what === "cloud" ? META.clouds : Object.keys(META.models)) {
    const found = object(id);
    if (found) found.visible = on;
  }
  K3DInstance.render();
}

// The camera is nine numbers: where it stands, where it looks, what is up (z).
function turn(angle) {
  const [x, y] = [camera[0] - camera[3], camera[1] - camera[4]];
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  look([camera[3] + c * x - s * y, camera[4] + s * x + c * y, ...camera.slice(2)]);
}

function zoom(factor) {
  look([0, 1, 2].map(i => camera[i + 3] + factor * (camera[i] - camera[i + 3])).concat(camera.slice(3)));
}

// The views are made for a frame as wide as high; a narrow one is looked at from farther away.
function view(name) {
  camera = META[name].slice();
  zoom(Math.max(1, (1.2 * world.height) / world.width));
}

K3DInstance.on(events.CAMERA_CHANGE, places => { camera = Array.from(places); });
K3DInstance.on(events.OBJECT_CLICKED, hit => {
  const number = META.models[hit.K3DIdentifier];
  if (number !== undefined) parent.postMessage({picked: number}, "*");
});
addEventListener("message", event => {
  if (event.source !== parent) return;
  const message = event.data;
  if ("select" in message) select(message.select);
  if ("show" in message) show(message.show, message.on);
  if ("view" in message) view(message.view);
  if ("turn" in message) turn(message.turn);
  if ("zoom" in message) zoom(message.zoom);
  if ("background" in message) { K3DInstance.setClearColor(message.background); K3DInstance.render(); }
});
K3DInstance.setViewMode("callback");
view("front");
parent.postMessage({ready: true}, "*");
