// Copies the text beside a button; works in a file, with the keyboard, and without the browser's clipboard.
for (const button of document.querySelectorAll("button.copy")) {
  const shown = document.getElementById(button.dataset.copies);
  const say = (text) => {
    button.textContent = text;
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  };
  const select = () => {
    const range = document.createRange();
    range.selectNodeContents(shown);
    const chosen = getSelection();
    chosen.removeAllRanges();
    chosen.addRange(range);
    say(document.execCommand("copy") ? "Copied" : "Press Ctrl-C");
  };
  button.hidden = false;
  button.setAttribute("aria-live", "polite");
  button.addEventListener("click", () => {
    if (!navigator.clipboard) return select();
    navigator.clipboard.writeText(shown.textContent).then(() => say("Copied"), select);
  });
}
