// Guidance frames of the service: one WebSocket, each frame answered, so that a slow link loses rate and not age.

import { headers, isRefused } from "./http.js";
import { onWake } from "./wake.js";

const RETRY_MIN_MS = 500;
const RETRY_MAX_MS = 8000;
const SILENCE_MS = 6000;

// Call `onFrame(frame)` for each frame, and `onLink(isLinked)` when the connection opens or closes.
// Each frame gets `receivedMs`, for its age. `requestToken()` is called if reading requires another token.
export function followGuidance(onFrame, onLink = () => {}, requestToken = null) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  let waitMs = RETRY_MIN_MS;
  let last = null;
  let endPresent = null;
  onWake((sleptMs) => {
    if (last) last.receivedMs -= sleptMs;
    endPresent?.();
  });
  const open = () => {
    const token = (headers().Authorization || "").replace("Bearer ", "");
    const protocols = token ? ["syntopic.v1", `bearer.${token}`] : ["syntopic.v1"];
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/guidance`, protocols);
    let silence = null;
    let isAdmitted = false;
    let hasEnded = false;
    // Also called if the service is silent: a browser may wait long for the end of a dead connection.
    const end = async () => {
      if (hasEnded) return;
      hasEnded = true;
      clearTimeout(silence);
      socket.close();
      onLink(false);
      if (requestToken && !isAdmitted && await isRefused()) {
        await requestToken();
        waitMs = RETRY_MIN_MS;
      }
      setTimeout(open, waitMs);
      waitMs = Math.min(waitMs * 2, RETRY_MAX_MS);
    };
    endPresent = end;
    const restart = () => {
      clearTimeout(silence);
      silence = setTimeout(end, SILENCE_MS);
    };
    // Also while it opens.
    restart();
    socket.onopen = () => {
      if (hasEnded) return;
      isAdmitted = true;
      onLink(true);
    };
    socket.onmessage = (message) => {
      if (hasEnded) return;
      waitMs = RETRY_MIN_MS;
      restart();
      const frame = JSON.parse(message.data);
      socket.send(String(frame.frame));
      frame.receivedMs = performance.now();
      last = frame;
      onFrame(frame);
    };
    socket.onclose = end;
  };
  open();
}

// Age of a frame now, in s: at the sender, half of the round trip, and the time since it came.
export function ageOf(frame, nowMs = performance.now()) {
  return frame.age_s + (frame.rtt_s ?? 0) / 2 + (nowMs - frame.receivedMs) / 1000;
}
