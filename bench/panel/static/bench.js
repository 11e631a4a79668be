"use strict";
// The form of a bench file or a procedure: a choice on which other fields depend shows them at once; a search that ends is shown.
(function () {
  const form = document.getElementById("bench");
  if (!form) return;
  const show = form.querySelector("button[value=show]");
  for (const choice of form.querySelectorAll("[data-shows]")) {
    choice.addEventListener("change", () => {
      form.action = form.action.split("#")[0] + "#" + choice.id;
      form.requestSubmit(show);
    });
  }
  const searching = form.querySelector("[data-searching]");
  const again = document.querySelector("[data-again]");
  if (!searching && !again) return;
  async function look() {
    try {
      const reply = await fetch("/bench/search", { headers: { accept: "application/json" } });
      if (!(await reply.json()).at_work) {
        const typing = document.activeElement && document.activeElement.matches("input, select, textarea");
        if (searching) searching.textContent = _("The search is done.");
        if (typing) return;
        if (again) location.reload();
        else form.requestSubmit(form.querySelector("[data-found]"));
        return;
      }
    } catch (error) {
      if (searching) searching.textContent = _("The panel does not answer; this page asks again.");
    }
    setTimeout(look, 500);
  }
  setTimeout(look, 500);
})();
