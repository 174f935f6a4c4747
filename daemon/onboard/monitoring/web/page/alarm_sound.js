// Sound and vibration of alarms: generated tones, one pattern for each of the two upper severities.

// Frequency in Hz and start in s of each tone; how often the pattern repeats, in ms; vibration in ms.
const PATTERNS = {
  warning: { tones: [[988, 0], [740, 0.22], [988, 0.44]], repeatMs: 4000, vibration: [300, 100, 300, 100, 300] },
  caution: { tones: [[660, 0], [660, 0.3]], repeatMs: 15000, vibration: [200, 150, 200] },
};
const TONE_S = 0.18;
const LOUDNESS = 0.5;

let context = null;
let severity = null;
// By a clock that no correction of the time sets back.
let soundedMs = -Infinity;

export const isSoundOn = () => localStorage.getItem("sound") !== "off";

export function setSound(wanted) {
  localStorage.setItem("sound", wanted ? "on" : "off");
}

// A browser plays no sound before the first touch or key.
export function unlockSound() {
  context ??= globalThis.AudioContext ? new AudioContext() : null;
  context?.resume().catch(() => {});
}

for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, unlockSound, { passive: true });

function play(pattern) {
  if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(pattern.vibration);
  if (!context || context.state !== "running") return;
  for (const [frequencyHz, startS] of pattern.tones) {
    const [tone, gain] = [context.createOscillator(), context.createGain()];
    const begins = context.currentTime + startS;
    tone.type = "square";
    tone.frequency.value = frequencyHz;
    // Ramps instead of steps: no click at either end.
    gain.gain.setValueAtTime(0, begins);
    gain.gain.linearRampToValueAtTime(LOUDNESS, begins + 0.01);
    gain.gain.setValueAtTime(LOUDNESS, begins + TONE_S - 0.02);
    gain.gain.linearRampToValueAtTime(0, begins + TONE_S);
    tone.connect(gain).connect(context.destination);
    tone.start(begins);
    tone.stop(begins + TONE_S);
  }
  document.body.dataset.sounded = String(Number(document.body.dataset.sounded || 0) + 1);
}

// Sound for the severest of the alarms that sound: at once if it became more severe, then repeatedly.
export function soundFor(severities, isTest = false) {
  const next = severities.includes("warning") ? "warning" : severities.includes("caution") ? "caution" : null;
  if (isTest) return play(PATTERNS.caution);
  const isWorse = next && next !== severity && severity !== "warning";
  severity = next;
  document.body.dataset.sounding = next && isSoundOn() ? next : "";
  if (!next || !isSoundOn()) return undefined;
  if (!isWorse && performance.now() - soundedMs < PATTERNS[next].repeatMs) return undefined;
  soundedMs = performance.now();
  return play(PATTERNS[next]);
}
