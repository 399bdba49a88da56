// Buttons that copy what stands beside them.
"use strict";

for (const button of document.querySelectorAll("[data-copy]")) {
  button.hidden = false;
  button.addEventListener("click", async () => {
    const source = document.getElementById(button.dataset.copy);
    try {
      // a browser may leave it open whether a page is allowed to
      const late = new Promise((_, give) => setTimeout(give, 1000));
      await Promise.race([navigator.clipboard.writeText(source.textContent), late]);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(source);
      button.textContent = "Selected";
    }
  });
}
