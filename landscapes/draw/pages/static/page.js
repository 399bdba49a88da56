// Buttons that copy what stands beside them.
"use strict";

// Whether a text is in the clipboard now.
async function copy(text) {
  try {
    // a browser may leave it open whether a page is allowed to
    const late = new Promise((_, give) => setTimeout(give, 1000));
    await Promise.race([navigator.clipboard.writeText(text), late]);
    return true;
  } catch {
    return false;
  }
}

for (const button of document.querySelectorAll("[data-copy]")) {
  button.hidden = false;
  button.addEventListener("click", async () => {
    const source = document.getElementById(button.dataset.copy);
    const copied = await copy(source.textContent);
    if (!copied) getSelection().selectAllChildren(source);
    button.textContent = copied ? "Copied" : "Selected";
  });
}
