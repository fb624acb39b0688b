//! Tool samples in a datagram.
//!
//! The samples are rounded ([`super::quantise`]) and the whole body is range-coded
//! ([`super::range_coder`]): count of tools
//! minus one, then per tool
//!
//! ```text
//! participant minus the header's `stream` | 6 minus the number of samples
//! whether from a baseline; if so: how many datagrams ago it was
//! times: the newest before `generated`, then the steps back, less 1 ms each, 2 ms from the fifth on
//! the newest sample: position, orientation, buttons, force
//! the oldest sample and then always the middle one of what is left, against what is known by then
//! ```
//!
//! A baseline is a datagram that the other side has acknowledged. The newest sample is expected where
//! the baseline's samples lead to, slowed down within [`LEAD_UNITS`]; the oldest one on the line from
//! the newest with the baseline's velocity; one between two others on the line between them. Without
//! a baseline the newest sample is told as it is.

use super::memory::Memory;
use super::quantise::{self, COMPONENT_MAX, POSITION_MAX, Point, TIME_STEP_US, Turn};
use super::range_coder::{Chance, Coder, Number};
use super::{Moment, TRACK_MAX_SAMPLES, TRACKS_MAX};
use crate::{ParticipantId, ProtocolError, ToolTrack};

/// Between two samples of the usual 1 kHz, in steps of time.
const PERIOD: i64 = 1000 / TIME_STEP_US;

/// A hand goes on for about 60 ms as it went; in steps of time.
const LEAD_UNITS: i64 = 60_000 / TIME_STEP_US;

/// New samples in a usual datagram. Of the batch before, every second one is repeated: what is lost with
/// a datagram is then between two that are 2 ms apart, where interpolation errs by less than a step.
pub(crate) const BATCH: usize = 4;

/// Samples in a usual datagram.
pub(crate) const USUAL_SAMPLES: usize = BATCH + BATCH / 2;

/// The usual step of time before the sample that is `rank` from the newest.
fn usual_step(rank: usize) -> i64 {
    if rank <= BATCH { PERIOD } else { 2 * PERIOD }
}

/// What is farther apart than this (in steps of time, about an hour) tells nothing about each other;
/// products with it stay within 64 bits.
const FAR_UNITS: i64 = 1 << 28;

/// What a datagram leaves behind for differences: its newest and its oldest sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Anchor {
    newest: Point,
    oldest: Point,
}

impl Anchor {
    /// Where the tool is expected `after` steps of time after the newest sample.
    fn ahead(&self, after: i64) -> Point {
        let after = after.clamp(0, FAR_UNITS);
        self.moved(after * LEAD_UNITS / (after + LEAD_UNITS))
    }

    /// The newest sample moved with the velocity between both.
    fn moved(&self, by: i64) -> Point {
        let span = (self.newest.time - self.oldest.time).max(1);
        on_line(&self.oldest, &self.newest, span + by, span)
    }
}

/// The point at `at` of `span` on the line from `a` to `b`, rounded to the nearest. Where both leave
/// out different parts of the rotation it is that of `b`.
fn on_line(a: &Point, b: &Point, at: i64, span: i64) -> Point {
    let mix = |x: i32, y: i32, most: i32| {
        let way = (i64::from(y) - i64::from(x)) * at;
        let rounded = (2 * way + span).div_euclid(2 * span);
        (i64::from(x) + rounded).clamp(-i64::from(most), i64::from(most)) as i32
    };
    let mix3 = |x: [i32; 3], y: [i32; 3], most| std::array::from_fn(|i| mix(x[i], y[i], most));
    let mut point = *b;
    point.position = mix3(a.position, b.position, POSITION_MAX);
    if a.turn.omitted == b.turn.omitted {
        point.turn.parts = mix3(a.turn.parts, b.turn.parts, COMPONENT_MAX);
    }
    point
}

/// The chances of everything in a body. The first values are from a band-limited hand of 87 mm/s rms
/// with a tremor of 0.1 mm at round trips of 20 to 200 ms.
struct Model {
    tracks: Number,
    participant: Number,
    samples: Number,
    ago: Number,
    age: Number,
    step: Number,
    /// Position and rotation: of the newest, of the oldest, and of one between.
    position: [Number; 3],
    turn: [Number; 3],
    force: Number,
    same_rotation: Chance,
    other_buttons: Chance,
    has_force: Chance,
    has_baseline: Chance,
}

impl Model {
    fn new() -> Self {
        let far = [254, 253, 251, 248, 240, 225, 200, 165, 125, 85, 50, 30];
        let near = [215, 190, 150, 100, 60, 40, 30];
        let between = [70, 30, 30];
        Self {
            tracks: Number::new(&[40]),
            participant: Number::new(&[128, 128, 160, 128]),
            samples: Number::new(&[20]),
            ago: Number::new(&[254, 252, 245, 220, 130, 60, 20]),
            age: Number::new(&[128, 240, 240, 235, 230, 225, 215, 200, 170, 130, 100]),
            step: Number::new(&[110, 40, 60, 100]),
            position: [Number::new(&far), Number::new(&near), Number::new(&between)],
            turn: [Number::new(&far), Number::new(&near), Number::new(&between)],
            force: Number::new(&[190, 210, 190, 170, 150, 130, 100]),
            same_rotation: Chance::RARE,
            other_buttons: Chance::RARE,
            has_force: Chance::of_one(30),
            has_baseline: Chance::of_one(240),
        }
    }
}

fn refuse(what: &'static str, detail: String) -> ProtocolError {
    ProtocolError::OutOfRange { what, detail }
}

/// Codes a point that is expected at `near`; its time is known.
fn code_point(
    c: &mut impl Coder,
    m: &mut Model,
    class: usize,
    near: &Point,
    p: Point,
) -> Result<Point, ProtocolError> {
    let mut out = Point {
        time: p.time,
        ..Point::default()
    };
    out.position = m.difference(c, true, class, p.position, near.position)?;
    out.turn = if c.bit(&mut m.same_rotation, p.turn.omitted != near.turn.omitted)? {
        code_turn(c, p.turn)?
    } else {
        Turn {
            omitted: near.turn.omitted,
            parts: m.difference(c, false, class, p.turn.parts, near.turn.parts)?,
        }
    };
    out.buttons = if c.bit(&mut m.other_buttons, p.buttons != near.buttons)? {
        c.raw(8, u32::from(p.buttons))? as u8
    } else {
        near.buttons
    };
    if c.bit(&mut m.has_force, p.force.is_some())? {
        let expected = near.force.unwrap_or_default();
        let force = p.force.unwrap_or_default();
        let difference = std::array::from_fn(|i| force[i].wrapping_sub(expected[i]));
        let difference = m.force.code3(c, difference)?;
        out.force = Some(std::array::from_fn(|i| expected[i] + difference[i]));
    }
    out.check()?;
    Ok(out)
}

impl Model {
    fn difference(
        &mut self,
        c: &mut impl Coder,
        of_position: bool,
        class: usize,
        value: [i32; 3],
        near: [i32; 3],
    ) -> Result<[i32; 3], ProtocolError> {
        let difference = std::array::from_fn(|i| value[i] - near[i]);
        let numbers = if of_position {
            &mut self.position
        } else {
            &mut self.turn
        };
        let difference = numbers[class].code3(c, difference)?;
        Ok(std::array::from_fn(|i| near[i] + difference[i]))
    }
}

/// A rotation as it is.
fn code_turn(c: &mut impl Coder, turn: Turn) -> Result<Turn, ProtocolError> {
    let omitted = c.raw(2, u32::from(turn.omitted))? as u8;
    let mut parts = [0; 3];
    for (out, part) in parts.iter_mut().zip(turn.parts) {
        *out = c.raw(15, (part + COMPONENT_MAX) as u32)? as i32 - COMPONENT_MAX;
    }
    Ok(Turn { omitted, parts })
}

/// A point as it is; its time is known.
fn code_whole(c: &mut impl Coder, p: Point) -> Result<Point, ProtocolError> {
    let mut out = Point {
        time: p.time,
        ..Point::default()
    };
    for (out, x) in out.position.iter_mut().zip(p.position) {
        *out = c.raw(21, (x + POSITION_MAX) as u32)? as i32 - POSITION_MAX;
    }
    out.turn = code_turn(c, p.turn)?;
    out.buttons = c.raw(8, u32::from(p.buttons))? as u8;
    if c.raw(1, u32::from(p.force.is_some()))? == 1 {
        let mut force = p.force.unwrap_or_default();
        for f in &mut force {
            *f = i32::from(c.raw(16, *f as u32)? as u16 as i16);
        }
        out.force = Some(force);
    }
    out.check()?;
    Ok(out)
}

/// Codes the samples of one tool, oldest first; a decoder gives as many as it wants to read.
fn code_points(
    c: &mut impl Coder,
    m: &mut Model,
    generated: i64,
    baseline: Option<Anchor>,
    points: &mut [Point],
) -> Result<Anchor, ProtocolError> {
    let last = points.len() - 1;
    let narrow = |t: i64| t.clamp(-i64::from(i32::MAX), i64::from(i32::MAX)) as i32;
    let age = m
        .age
        .code(c, narrow(generated.saturating_sub(points[last].time)))?;
    points[last].time = generated.saturating_sub(i64::from(age));
    for i in (0..last).rev() {
        let usual = usual_step(last - i);
        let step = points[i + 1].time.saturating_sub(points[i].time);
        let step = i64::from(m.step.code(c, narrow(step - usual))?) + usual;
        if step < 0 {
            return Err(refuse("the step between samples", format!("{step} steps")));
        }
        points[i].time = points[i + 1].time.saturating_sub(step);
    }
    points[last] = match &baseline {
        Some(anchor) => {
            let after = points[last].time.saturating_sub(anchor.newest.time);
            code_point(c, m, 0, &anchor.ahead(after), points[last])?
        }
        None => code_whole(c, points[last])?,
    };
    let newest = points[last];
    if last > 0 {
        let back = points[0].time.saturating_sub(newest.time);
        let near = match &baseline {
            Some(a) if a.newest.turn.omitted == newest.turn.omitted => {
                // The newest motion that is known: from the baseline to here.
                let span = newest.time.saturating_sub(a.newest.time);
                if (1..FAR_UNITS).contains(&span) {
                    on_line(&a.newest, &newest, span + back, span)
                } else {
                    newest
                }
            }
            _ => newest,
        };
        let near = Point {
            force: newest.force,
            buttons: newest.buttons,
            ..near
        };
        points[0] = code_point(c, m, 1, &near, points[0])?;
        code_between(c, m, points, 0, last)?;
    }
    Ok(Anchor {
        newest,
        oldest: points[0],
    })
}

/// Codes what lies between two that are known, the middle one first.
fn code_between(
    c: &mut impl Coder,
    m: &mut Model,
    points: &mut [Point],
    from: usize,
    to: usize,
) -> Result<(), ProtocolError> {
    if to - from < 2 {
        return Ok(());
    }
    let middle = usize::midpoint(from, to);
    let (a, b) = (points[from], points[to]);
    let span = (b.time - a.time).max(1);
    let near = on_line(&a, &b, points[middle].time - a.time, span);
    points[middle] = code_point(c, m, 2, &near, points[middle])?;
    code_between(c, m, points, from, middle)?;
    code_between(c, m, points, middle, to)
}

fn write_track(
    c: &mut impl Coder,
    m: &mut Model,
    at: Moment,
    memory: &Memory,
    track: &ToolTrack,
) -> Result<Anchor, ProtocolError> {
    let count = track.samples.len();
    let Some(newest) = track.samples.last().filter(|_| count <= TRACK_MAX_SAMPLES) else {
        return Err(refuse("the number of samples", count.to_string()));
    };
    let stream = i32::from(at.stream);
    m.participant
        .code(c, i32::from(track.participant.0) - stream)?;
    m.samples.code(c, USUAL_SAMPLES as i32 - count as i32)?;
    let known = memory.known_point(track.participant);
    c.bit(&mut m.has_baseline, known.is_some())?;
    if let Some((sequence, _)) = known {
        m.ago.code(c, at.sequence.wrapping_sub(sequence) as i32)?;
    }
    let baseline = known.map(|(_, anchor)| anchor);
    let newest = Point::of(newest, baseline.map(|a| a.newest.turn))?;
    let mut points = Vec::with_capacity(count);
    for sample in &track.samples {
        points.push(Point::of(sample, Some(newest.turn))?);
    }
    points[count - 1] = newest;
    code_points(c, m, quantise::time(at.generated), baseline, &mut points)
}

fn read_track(
    c: &mut impl Coder,
    m: &mut Model,
    at: Moment,
    memory: &Memory,
) -> Result<(ToolTrack, Anchor), ProtocolError> {
    let participant = i32::from(at.stream) + m.participant.code(c, 0)?;
    let participant = u16::try_from(participant)
        .map(ParticipantId)
        .map_err(|_| refuse("a participant", participant.to_string()))?;
    let count = USUAL_SAMPLES as i32 - m.samples.code(c, 0)?;
    let count = usize::try_from(count).unwrap_or(0);
    if !(1..=TRACK_MAX_SAMPLES).contains(&count) {
        return Err(refuse("the number of samples", count.to_string()));
    }
    let baseline = if c.bit(&mut m.has_baseline, false)? {
        let sequence = at.sequence.wrapping_sub(m.ago.code(c, 0)? as u32);
        let known = memory.point_at(participant, sequence);
        Some(known.ok_or(ProtocolError::NoBaseline { sequence })?)
    } else {
        None
    };
    let mut points = [Point::default(); TRACK_MAX_SAMPLES];
    let points = &mut points[..count];
    let anchor = code_points(c, m, quantise::time(at.generated), baseline, points)?;
    let samples = points.iter().map(Point::sample).collect();
    let track = ToolTrack {
        participant,
        samples,
    };
    Ok((track, anchor))
}

/// Writes the body, and remembers what it says.
pub(super) fn write(
    c: &mut impl Coder,
    at: Moment,
    memory: &mut Memory,
    tracks: &[ToolTrack],
) -> Result<(), ProtocolError> {
    if tracks.len() > TRACKS_MAX {
        return Err(refuse("the number of tools", tracks.len().to_string()));
    }
    let mut m = Model::new();
    m.tracks.code(c, tracks.len() as i32 - 1)?;
    for track in tracks {
        let anchor = write_track(c, &mut m, at, memory, track)?;
        memory.remember_point(track.participant, at.sequence, anchor);
    }
    Ok(())
}

/// Reads the body, and remembers what it says.
pub(super) fn read(
    c: &mut impl Coder,
    at: Moment,
    memory: &mut Memory,
) -> Result<Vec<ToolTrack>, ProtocolError> {
    let mut m = Model::new();
    let count = m.tracks.code(c, 0)? + 1;
    let fits = usize::try_from(count).is_ok_and(|n| n <= TRACKS_MAX);
    if !fits {
        return Err(refuse("the number of tools", count.to_string()));
    }
    let mut tracks = Vec::new();
    for _ in 0..count {
        let (track, anchor) = read_track(c, &mut m, at, memory)?;
        memory.remember_point(track.participant, at.sequence, anchor);
        tracks.push(track);
    }
    Ok(tracks)
}
