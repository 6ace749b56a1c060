// The projector page: draws gray patterns pixel by pixel and says when they were submitted to the screen.
"use strict";

const canvas = document.getElementById("screen");
const notice = document.getElementById("notice");
const context = canvas.getContext("2d", { alpha: false, colorSpace: "srgb" });
const name = new URLSearchParams(location.search).get("name") || "projector";

let device = { width: 0, height: 0 };
let slots = new Map();
let awaited = null; // the slot that the next binary message fills
let socket = null;
let delay = 100;
let wasOpen = false;
let lock = null;
let period = null; // of the screen's refresh, in [ms]; null: not measured yet
let measuring = 0;

function geometry() {
  return {
    width_px: device.width,
    height_px: device.height,
    ratio: devicePixelRatio,
    scale: visualViewport ? visualViewport.scale : 1,
    visible: document.visibilityState === "visible",
    screen_x: screenX,
    screen_y: screenY,
    refresh_period_ms: period,
    screen: `${screen.width}x${screen.height}${screen.isExtended ? " of several" : ""}`,
  };
}

// Pages of ours know who is logged in; the websocket doesn't tell why it was refused.
async function whyRefused() {
  try {
    const answer = await fetch("/api/me", { cache: "no-store" });
    if (answer.status === 401) return "Nobody is logged in here any more: reload this page and log in.";
    if (answer.ok && (await answer.json()).role !== "operator") {
      return "Viewers have no projector: log out, and log in with the operators' token.";
    }
  } catch {
    // the server is gone, which the sentence below says
  }
  return "There is no connection to unglare; trying again …";
}

function send(message) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function tellGeometry() {
  if (!device.width) return; // not measured yet
  send({ t: "geometry", ...geometry() });
}

// The screen's refresh period over so many animation frames; what skips one or comes late doesn't count.
function measureRefresh() {
  const times = [];
  const run = ++measuring; // a later one takes over
  const note = (now) => {
    if (run !== measuring || document.visibilityState !== "visible") return;
    times.push(now);
    if (times.length <= 90) return requestAnimationFrame(note);
    const gaps = times.slice(1).map((time, i) => time - times[i]).sort((a, b) => a - b);
    const median = gaps[gaps.length >> 1];
    const regular = gaps.filter((gap) => Math.abs(gap - median) < 0.2 * median);
    const mean = regular.reduce((sum, gap) => sum + gap, 0) / regular.length;
    if (!(mean > 0)) return;
    period = mean;
    tellGeometry();
  };
  requestAnimationFrame(note);
}

function layOut() {
  canvas.style.width = `${canvas.width / devicePixelRatio}px`;
  canvas.style.height = `${canvas.height / devicePixelRatio}px`;
}

function sized(width, height) {
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  layOut();
}

function picture(gray, width, height) {
  const pixels = new Uint32Array(width * height);
  for (let i = 0; i < pixels.length; i++) {
    const v = gray[i];
    pixels[i] = 0xff000000 | (v << 16) | (v << 8) | v;
  }
  return new ImageData(new Uint8ClampedArray(pixels.buffer), width, height);
}

// After two animation frames the picture was handed to the screen.
function acknowledge(id) {
  requestAnimationFrame((drawn) =>
    requestAnimationFrame((presented) => send({ t: "ack", id, drawn, presented, geometry: geometry() })));
}

function show(message) {
  const image = slots.get(message.slot);
  if (!image) return send({ t: "error", id: message.id, code: "no-slot" });
  hideNotice();
  sized(image.width, image.height);
  context.putImageData(image, 0, 0);
  acknowledge(message.id);
}

function blank(message) {
  hideNotice();
  sized(message.w, message.h);
  context.fillStyle = `rgb(${message.level} ${message.level} ${message.level})`;
  context.fillRect(0, 0, message.w, message.h);
  acknowledge(message.id);
}

function receive(event) {
  if (event.data instanceof ArrayBuffer) {
    const { slot, w, h } = awaited;
    slots.set(slot, picture(new Uint8Array(event.data), w, h));
    awaited = null;
    return;
  }
  const message = JSON.parse(event.data);
  if (message.t === "load") {
    if (message.slot === 0) slots = new Map();
    awaited = message;
  } else if (message.t === "show") show(message);
  else if (message.t === "blank") blank(message);
  else if (message.t === "refuse") refuse(message.text);
}

// Words for whoever stands at the projector, read from some metres away; the pattern below them is put out.
function say(text, hint = "") {
  context.fillStyle = "#000";
  context.fillRect(0, 0, canvas.width, canvas.height);
  notice.firstElementChild.textContent = text;
  notice.lastElementChild.textContent = hint;
  notice.className = "";
  notice.hidden = false;
  document.documentElement.classList.add("speaks");
}

function refuse(text) {
  say(text, `This window: ${device.width} × ${device.height} device pixels at ratio ${devicePixelRatio.toFixed(2)}, ` +
    `${screen.width} × ${screen.height} on its screen.`);
  notice.className = "refused";
}

function hideNotice() {
  notice.hidden = true;
  document.documentElement.classList.remove("speaks");
}

function fullScreenHint() {
  const fills = Math.abs(outerHeight - screen.height) < 2 && Math.abs(innerHeight - outerHeight) < 2;
  return fills ? "" : "Not full screen: move this window to the projector's monitor and press F11 (or click).";
}

function greet() {
  say(`Projector page “${name}” waits for patterns: ${device.width} × ${device.height} device pixels.`, fullScreenHint());
}

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/ws/projector?name=${encodeURIComponent(name)}`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    delay = 100;
    wasOpen = true;
    greet();
    tellGeometry();
  };
  socket.onmessage = receive;
  socket.onclose = (event) => {
    slots = new Map();
    if (event.code === 4009) {
      return say("Another page is this projector already: close one of them and reload.", "Another projector? Give it a page of its own: /projector?name=…");
    }
    if (wasOpen) say("The connection to unglare is lost; connecting again …");
    else whyRefused().then((text) => { if (socket.readyState !== WebSocket.OPEN) say(text); }); // a later try may have worked
    wasOpen = false;
    setTimeout(connect, delay);
    delay = Math.min(2 * delay, 5000);
  };
}

async function stayAwake() {
  try {
    lock = await navigator.wakeLock.request("screen");
  } catch {
    lock = null; // refused or unknown: the operating system's own settings decide
  }
}

new ResizeObserver((entries) => {
  const box = entries[0].devicePixelContentBoxSize[0];
  device = { width: box.inlineSize, height: box.blockSize };
  layOut();
  tellGeometry();
  if (socket && socket.readyState === WebSocket.OPEN && !notice.hidden) greet();
}).observe(document.documentElement, { box: "device-pixel-content-box" });

// A zoom keeps the device pixels but changes their ratio: it is watched by itself.
(function watchRatio() {
  matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", () => {
    layOut();
    tellGeometry();
    watchRatio();
  }, { once: true });
})();

// Two fingers zoom without changing either.
if (window.visualViewport) visualViewport.addEventListener("resize", tellGeometry);

// Neither keys nor wheel may zoom what is projected.
addEventListener("keydown", (event) => {
  if ((event.ctrlKey || event.metaKey) && ["+", "-", "=", "0"].includes(event.key)) event.preventDefault();
});
addEventListener("wheel", (event) => { if (event.ctrlKey) event.preventDefault(); }, { passive: false });
addEventListener("contextmenu", (event) => event.preventDefault());
// A click on its words fills the screen; on a pattern it does nothing.
addEventListener("click", () => {
  if (!notice.hidden && !document.fullscreenElement) document.documentElement.requestFullscreen().catch(() => {});
});
document.addEventListener("visibilitychange", () => {
  tellGeometry();
  if (document.visibilityState !== "visible") return;
  if (!notice.hidden && socket && socket.readyState === WebSocket.OPEN) greet();
  stayAwake();
  measureRefresh();
});
// A window that is moved to another screen gets no event of its own.
let place = "";
setInterval(() => {
  const here = `${screenX} ${screenY} ${screen.width} ${screen.height}`;
  if (here !== place) {
    place = here;
    tellGeometry();
    measureRefresh(); // another screen may have another rate
  }
}, 250);

stayAwake();
connect();
