"use strict";
// A link from elsewhere brings no cookie along (SameSite=Strict): whoever is logged in goes on from here.
const next = document.querySelector("input[name=next]").value;
fetch("/login/who", { cache: "no-store" })
  .then((answer) => answer.json())
  .then((known) => { if (known.user) location.replace(next); })
  .catch(() => {});

// The name is remembered on this machine, the token never.
const nameField = document.getElementById("name");
const tokenField = document.getElementById("token");
try {
  nameField.value ||= localStorage.getItem("unglare.name") ?? "";
  document.querySelector("form").addEventListener("submit", () => {
    localStorage.setItem("unglare.name", nameField.value.trim());
  });
} catch (error) { /* storage is switched off: type it again */ }
if (document.querySelector(".error").textContent) tokenField.setAttribute("aria-invalid", "true");
if (nameField.value) tokenField.focus();
