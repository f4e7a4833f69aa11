// When what came is drawn: thirty pictures a second where the machine can, and never so much at once that a button has to wait.

const PICTURE_MS = 1000 / 30;
const FRAME_MS = 12; // the most to draw in one frame of the browser
const REST = 2; // times what a frame took stay free after it, for buttons and messages

export class Frames {
  // `parts` gives, at the start of a picture, the functions that draw its parts.
  constructor(parts) {
    this.parts = parts;
    this.left = [];
    this.partMs = 0;
    this.restUntil = this.startedAt = 0;
    this.pictures = this.spent = this.fps = this.pictureMs = 0;
    this.countedAt = performance.now();
    // What a frame costs is known when it is painted: without a graphics card most of the work comes after the drawing calls.
    this.painted = new MessageChannel();
    this.painted.port1.onmessage = ({ data }) => this.paid(data.began, data.count);
    requestAnimationFrame((at) => this.turn(at));
  }

  turn(at) {
    requestAnimationFrame((next) => this.turn(next));
    const began = performance.now();
    if (began < this.restUntil || !this.next(at)) return;
    const most = this.partMs ? Math.max(1, Math.floor(FRAME_MS / this.partMs)) : this.left.length;
    const now = this.left.splice(0, most);
    for (const draw of now) draw();
    this.restUntil = Infinity; // until it is painted
    this.painted.port2.postMessage({ began, count: now.length });
  }

  // Whether there is something to draw.
  next(at) {
    if (this.left.length) return true;
    if (at - this.startedAt < PICTURE_MS - 4) return false;
    this.startedAt = at;
    this.left = this.parts();
    this.pictures++;
    return this.left.length > 0;
  }

  paid(began, count) {
    const now = performance.now(), took = now - began;
    this.spent += took;
    this.partMs += 0.3 * (took / count - this.partMs);
    this.restUntil = now + (took > FRAME_MS ? REST * took : 0);
  }

  // Pictures a second and the cost of one, since the last call.
  count() {
    const now = performance.now();
    this.fps = (this.pictures * 1000) / (now - this.countedAt);
    this.pictureMs = this.spent / Math.max(1, this.pictures);
    this.pictures = this.spent = 0;
    this.countedAt = now;
  }
}
