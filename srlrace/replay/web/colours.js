// Colours: viridis for speed (ordered in grey too, and for the colour-blind), Okabe and Ito's palette for flights.

const VIRIDIS = ["#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39", "#fde725"];

// The ends that would vanish on the background are left out.
const RANGE = { dark: [0.16, 1.0], light: [0.0, 0.88] };

const FLIGHTS = {
  dark: ["#56b4e9", "#e69f00", "#2fc79a", "#f0e442", "#e58fc0", "#ff8352", "#9db7ff", "#c9d1d9"],
  light: ["#0072b2", "#d55e00", "#00795a", "#8c6d00", "#a8437f", "#b3470a", "#3b4cc0", "#3d4650"],
};

export const SCENE = {
  dark: {
    sky: "#0d1218", floor: "#121921", line: "#2a3644", bounds: "#3a4858", obstacle: "#6b7888", shell: "#ff8352",
    next: "#ff9d3c", coming: "#aab6c3", passed: "#2f7f78", drone: "#dfe6ee", accent: "#ff8352", thrust: "#ffd27a",
    ghost: "#f2f5f8", label: "#f4f7fa", plate: "#0d1218",
  },
  light: {
    sky: "#f3f5f7", floor: "#e6eaee", line: "#bcc6d0", bounds: "#a3afbb", obstacle: "#8996a4", shell: "#d55e00",
    next: "#e06a00", coming: "#5d6a78", passed: "#2f8f86", drone: "#27313c", accent: "#d55e00", thrust: "#c07a00",
    ghost: "#101418", label: "#10161c", plate: "#ffffff",
  },
};

export function rgb(hex) {
  return [1, 3, 5].map((place) => parseInt(hex.slice(place, place + 2), 16) / 255);
}

/** Eight colours from slow to fast, each [r, g, b] in 0..1. */
export function speedRamp(theme) {
  const [low, high] = RANGE[theme];
  return VIRIDIS.map((_, index) => viridis(low + ((high - low) * index) / (VIRIDIS.length - 1)));
}

function viridis(share) {
  const place = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1);
  const index = Math.min(Math.floor(place), VIRIDIS.length - 2);
  const [from, to] = [rgb(VIRIDIS[index]), rgb(VIRIDIS[index + 1])];
  return from.map((value, channel) => value + (to[channel] - value) * (place - index));
}

/** CSS colour of a speed, given its share of the fastest. */
export function speedCss(ramp, share) {
  const place = Math.min(Math.max(share, 0), 1) * (ramp.length - 1);
  const index = Math.min(Math.floor(place), ramp.length - 2);
  const mixed = ramp[index].map((value, channel) => value + (ramp[index + 1][channel] - value) * (place - index));
  return css(mixed);
}

export function css(colour) {
  return `rgb(${colour.map((value) => Math.round(value * 255)).join(" ")})`;
}

export function flightColour(flight, theme) {
  return flight.ghost ? SCENE[theme].ghost : FLIGHTS[theme][flight.index % FLIGHTS[theme].length];
}
