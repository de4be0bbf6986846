// Colours of strips, by number: neighbours differ, and each stands out from the page by day and by night.
const DAY = ["#a3501a", "#00639c", "#b8336a", "#00735c", "#6a4fb3", "#7a5c00"];
const NIGHT = ["#f0955a", "#5cb8f5", "#f08ab4", "#3ecfa6", "#b39df0", "#e0c050"];

export function stripColour(number) {
  const colours = document.documentElement.hasAttribute("data-night") ? NIGHT : DAY;
  return number > 0 ? colours[number % colours.length] : getComputedStyle(document.documentElement).getPropertyValue("--soft").trim();
}

export const stripName = (number) => (number > 0 ? `strip ${number}` : "between strips");
