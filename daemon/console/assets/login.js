// Takes the token from the address of the QR code, or from the field, and opens a session.
const token = document.getElementById("token");
const answer = document.getElementById("answer");

async function open() {
  const asked = await fetch("/session", {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify({ token: token.value.trim() }),
  });
  if (asked.ok) {
    location.replace("/");
    return;
  }
  answer.textContent = (await asked.json()).error;
}

document.getElementById("login").addEventListener("submit", (event) => {
  event.preventDefault();
  open();
});
if (location.hash.length > 1) {
  token.value = decodeURIComponent(location.hash.slice(1));
  history.replaceState(null, "", "/login"); // the token does not stay in the browser's list of pages
  open();
}
