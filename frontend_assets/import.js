"use strict";
const form = document.querySelector("form");
const area = document.querySelector(".drop");
const input = document.getElementById("file");
const nameField = document.getElementById("name");
const button = document.querySelector("button");
const progress = document.getElementById("progress");
const error = document.querySelector(".error");
let file = null;

function choose(chosen) {
  if (!chosen) return;
  file = chosen;
  document.getElementById("chosen").textContent = `${file.name} (${(file.size / 2 ** 20).toFixed(1)} MiB)`;
  nameField.placeholder = file.name.replace(/\.zip$/i, "");
  button.disabled = false;
  error.textContent = "";
}

input.addEventListener("change", () => choose(input.files[0]));
for (const kind of ["dragenter", "dragover"]) {
  area.addEventListener(kind, (event) => { event.preventDefault(); area.classList.add("over"); });
}
for (const kind of ["dragleave", "drop"]) {
  area.addEventListener(kind, (event) => { event.preventDefault(); area.classList.remove("over"); });
}
area.addEventListener("drop", (event) => choose(event.dataTransfer.files[0]));

function failed(sentence) {
  error.textContent = sentence;
  progress.hidden = true;
  button.disabled = false;
  button.textContent = "Import";
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  button.disabled = true;
  progress.hidden = false;
  error.textContent = "";
  // XMLHttpRequest, because fetch doesn't tell how far an upload is.
  const upload = new XMLHttpRequest();
  const name = nameField.value.trim() || nameField.placeholder;
  upload.open("POST", `/api/imports/upload?name=${encodeURIComponent(name)}`);
  upload.setRequestHeader("Content-Type", "application/zip");
  upload.upload.addEventListener("progress", (step) => {
    if (!step.lengthComputable) return;
    progress.value = step.loaded / step.total;
    button.textContent = step.loaded < step.total ? `${Math.round(100 * progress.value)} %` : "Reading the frames";
  });
  upload.addEventListener("load", () => {
    if (upload.status === 401) { location.href = "/login?next=/import"; return; }
    if (upload.status < 300) { location.href = "/station/"; return; }
    try { failed(JSON.parse(upload.responseText).detail); } catch { failed(`The server answered ${upload.status}.`); }
  });
  upload.addEventListener("error", () => failed("The connection broke during the upload; try again."));
  upload.send(file);
});
