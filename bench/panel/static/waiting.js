"use strict";
// A page that waits for a process: it is fetched again until the process ends, and only then shown again.
(function () {
  const waiting = document.querySelector("[data-waiting]");
  if (!waiting) return;
  async function look() {
    try {
      const reply = await fetch(location.href, { headers: { accept: "text/html" }, redirect: "follow" });
      const page = new DOMParser().parseFromString(await reply.text(), "text/html");
      const now = page.querySelector("[data-waiting]");
      if (!now) { location.reload(); return; }
      if (now.textContent !== waiting.textContent) waiting.textContent = now.textContent;
    } catch (error) {
      waiting.textContent = _("The panel does not answer; this page asks again.");
    }
    setTimeout(look, 1000);
  }
  setTimeout(look, 1000);
})();
