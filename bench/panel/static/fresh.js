"use strict";
// A part of a page that others change: it is asked for again, and replaced where it differs and nobody is in it.
(function () {
  const part = () => document.getElementById("fresh");
  if (!part()) return;
  async function look() {
    try {
      const reply = await fetch(location.href, { headers: { accept: "text/html" } });
      const now = new DOMParser().parseFromString(await reply.text(), "text/html").getElementById("fresh");
      const busy = part().contains(document.activeElement);
      if (now && !busy && now.innerHTML !== part().innerHTML) part().replaceWith(document.adoptNode(now));
    } catch (error) { /* the panel is silent; the next look may succeed */ }
    setTimeout(look, 3000);
  }
  setTimeout(look, 3000);
})();
