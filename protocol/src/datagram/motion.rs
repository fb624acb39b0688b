//! Tool samples in a datagram.
//!
//! The samples are rounded (`quantise.rs`) and the whole body is range-coded (`range_coder.rs`): count
//! of tools minus one, then per tool
//!
//! ```text
//! participant minus the connection's | 5 minus the number of samples
//! lateness that machines caused to the newest sample, ms | additional lateness of the oldest news, ms
//! whether from a baseline; if so: how many datagrams ago it was
//! times: of the newest, see below; then the steps back, less 1 ms each
//! the newest sample: position, orientation, buttons, force
//! the oldest sample and then always the middle one of the rest, relative to the samples coded before
//! ```
//!
//! A baseline is a datagram that the other side has acknowledged. The newest sample is predicted from
//! the baseline's samples, with the velocity fading within `LEAD_UNITS`. The oldest one is predicted on
//! the parabola through the newest of the baseline with its velocity and through the newest sample
//! (beyond `PARABOLA_UNITS` on the line through both). A sample between two others is predicted on the
//! line between them. Without a baseline the newest sample is sent without prediction.
//!
//! The newest sample of the first tool of a whole datagram has the time in the header. With a baseline,
//! the time of any other newest sample is coded as a number of usual batches of `BATCH` ms after the
//! baseline (as datagrams less batches) and a remainder. Without a baseline the first tool sends the low
//! 16 bits of its time, another one the difference to the first.

use super::header::nearest_time;
use super::late::code_lateness;
use super::memory::Memory;
use super::quantise::{self, COMPONENT_MAX, POSITION_MAX, Point, QuantisedRotation, TIME_STEP_US};
use super::range_coder::{Chance, Coder, Number};
use super::{Moment, TRACK_MAX_SAMPLES, TRACKS_MAX};
use crate::lateness::Lateness;
use crate::{ParticipantId, ProtocolError, ToolTrack};

/// Between two samples of the usual 1 kHz, in steps of time.
const PERIOD: i64 = 1000 / TIME_STEP_US;

/// Time constant of a hand's velocity, about 60 ms, in steps of time.
const LEAD_UNITS: i64 = 60_000 / TIME_STEP_US;

/// New samples in a usual datagram.
pub(crate) const BATCH: usize = 4;

/// Samples in a usual datagram: the last one of the batch before is repeated. The samples of one lost
/// datagram then lie between two samples 4 ms apart, where a straight line is within a h²/8 = 2.4 µm of
/// a hand that accelerates by 1.2 m/s².
pub(crate) const USUAL_SAMPLES: usize = BATCH + 1;

/// A sample between two others within this many steps of its prediction is sent as predicted: most such
/// differences are rounding. Its error is then at most 0.02 mm; the newest and the oldest sample keep
/// the accuracy of their step.
const TOLERANCE: i32 = 1;

/// The time of a usual batch, in steps.
const BATCH_UNITS: i64 = BATCH as i64 * PERIOD;

/// Samples farther apart (in steps of time, about an hour) do not predict each other; products with the
/// difference stay within 64 bits.
const FAR_UNITS: i64 = 1 << 28;

impl Point {
    /// Replaces the point by the prediction within [`TOLERANCE`].
    fn settle(&mut self, near: &Self) {
        let settle = |parts: &mut [i32; 3], near: [i32; 3]| {
            for (x, near) in parts.iter_mut().zip(near) {
                if x.abs_diff(near) <= TOLERANCE as u32 {
                    *x = near;
                }
            }
        };
        settle(&mut self.position, near.position);
        if self.turn.omitted == near.turn.omitted {
            settle(&mut self.turn.parts, near.turn.parts);
        }
    }
}

/// A baseline whose velocity is older than this, in steps of time, does not predict the curvature since
/// then; products with it stay within 64 bits.
const PARABOLA_UNITS: i64 = 200_000 / TIME_STEP_US;

/// The largest distance of baseline samples that give a velocity, in steps of time.
const VELOCITY_UNITS: i64 = 50_000 / TIME_STEP_US;

/// The anchor of a datagram for later differences: its newest and its oldest sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Anchor {
    newest: Point,
    oldest: Point,
}

impl Anchor {
    /// The predicted pose of the tool `after` steps of time after the newest sample.
    fn extrapolated(&self, after: i64) -> Point {
        let after = after.clamp(0, FAR_UNITS);
        self.moved(after * LEAD_UNITS / (after + LEAD_UNITS))
    }

    /// The newest sample moved with the velocity between both.
    fn moved(&self, by: i64) -> Point {
        let span = (self.newest.time - self.oldest.time).max(1);
        on_line(&self.oldest, &self.newest, span + by, span)
    }
}

/// The point at `at`, in steps of time from the baseline's newest sample, on the parabola that starts there
/// with its velocity and reaches `b` after `span`.
fn on_parabola(base: &Anchor, b: &Point, at: i64, span: i64) -> Point {
    let a = &base.newest;
    let before = (a.time - base.oldest.time).max(1);
    let straight = on_line(a, b, at, span);
    let is_near = span <= PARABOLA_UNITS && at.abs() <= PARABOLA_UNITS && before <= VELOCITY_UNITS;
    if !is_near || base.oldest.turn.omitted != b.turn.omitted {
        return straight;
    }
    // x0 + v t + (x1 - x0 - v T) t²/T² with v = (x0 - x_before) / before.
    let bend = |x: i32, y: i32, z: i32, most: i32| {
        let (y, z) = (i64::from(y), i64::from(z));
        let v = y - i64::from(x);
        let over = before * span * span;
        let way = v * at * span * span + ((z - y) * before - v * span) * at * at;
        let rounded = (2 * way + over).div_euclid(2 * over);
        (y + rounded).clamp(-i64::from(most), i64::from(most)) as i32
    };
    let bend3 = |x: [i32; 3], y: [i32; 3], z: [i32; 3], most| {
        std::array::from_fn(|i| bend(x[i], y[i], z[i], most))
    };
    let mut point = straight;
    let o = &base.oldest;
    point.position = bend3(o.position, a.position, b.position, POSITION_MAX);
    point.turn.parts = bend3(o.turn.parts, a.turn.parts, b.turn.parts, COMPONENT_MAX);
    point
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

/// The probabilities for all symbols in a body. The initial values are from a band-limited hand of 87
/// mm/s rms with a tremor of 0.1 mm at round trips of 20 to 200 ms.
struct Model {
    tracks: Number,
    participant: Number,
    samples: Number,
    late: Number,
    ago: Number,
    batches: Number,
    rest: Number,
    age: Number,
    step: Number,
    /// Position and rotation: of the newest, of the oldest, and of one between.
    position: [Number; 3],
    turn: [Number; 3],
    force: Number,
    other_part: Chance,
    other_buttons: Chance,
    /// Of the newest, and of all others.
    has_force: [Chance; 2],
    has_baseline: Chance,
}

impl Model {
    fn new() -> Self {
        let near = [215, 190, 150, 100, 60, 40, 30];
        let between = [4, 80, 60];
        Self {
            tracks: Number::new(&[40]),
            participant: Number::new(&[90, 160, 160, 128]),
            samples: Number::new(&[20]),
            late: Number::mostly_positive(&[2, 200, 200, 200, 128]),
            ago: Number::mostly_positive(&[255, 254, 248, 225, 150, 140, 60, 40]),
            batches: Number::mostly_positive(&[130, 130, 60, 90, 120]),
            rest: Number::new(&[120, 40, 60, 100, 150, 200]),
            age: Number::new(&[128, 240, 240, 235, 230, 225, 215, 200, 170, 130, 100]),
            step: Number::new(&[80, 25, 50, 100]),
            position: [Number::around(6), Number::new(&near), Number::new(&between)],
            turn: [Number::around(5), Number::new(&near), Number::new(&between)],
            force: Number::new(&[190, 210, 190, 170, 150, 130, 100]),
            other_part: Chance::RARE,
            other_buttons: Chance::RARE,
            has_force: [Chance::of_one(9), Chance::RARE],
            has_baseline: Chance::of_one(240),
        }
    }
}

fn refuse(what: &'static str, detail: String) -> ProtocolError {
    ProtocolError::OutOfRange { what, detail }
}

/// Codes a point that is predicted at `near`; its time is known.
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
    out.turn = if c.bit(&mut m.other_part, p.turn.omitted != near.turn.omitted)? {
        code_rotation(c, p.turn)?
    } else {
        QuantisedRotation {
            omitted: near.turn.omitted,
            parts: m.difference(c, false, class, p.turn.parts, near.turn.parts)?,
        }
    };
    out.buttons = if c.bit(&mut m.other_buttons, p.buttons != near.buttons)? {
        c.raw(8, u32::from(p.buttons))? as u8
    } else {
        near.buttons
    };
    if c.bit(&mut m.has_force[class.min(1)], p.force.is_some())? {
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
    /// Probabilities for a newest sample this many steps of time after its baseline: the prediction
    /// error of a quick hand is some 64 steps of position after 50 ms and 256 after 200 ms.
    fn expect(&mut self, after: i64) {
        let sixteenths = after.clamp(0, FAR_UNITS) as u32 / 16;
        let bits = (u32::BITS - sixteenths.leading_zeros()).clamp(2, 12);
        self.position[0] = Number::around(bits);
        self.turn[0] = Number::around(bits - 1);
    }

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

/// A rotation without prediction.
fn code_rotation(
    c: &mut impl Coder,
    turn: QuantisedRotation,
) -> Result<QuantisedRotation, ProtocolError> {
    let omitted = c.raw(2, u32::from(turn.omitted))? as u8;
    let mut parts = [0; 3];
    for (out, part) in parts.iter_mut().zip(turn.parts) {
        *out = c.raw(14, (part + COMPONENT_MAX) as u32)? as i32 - COMPONENT_MAX;
    }
    Ok(QuantisedRotation { omitted, parts })
}

/// A point without prediction; its time is known.
fn code_whole(c: &mut impl Coder, p: Point) -> Result<Point, ProtocolError> {
    let mut out = Point {
        time: p.time,
        ..Point::default()
    };
    for (out, x) in out.position.iter_mut().zip(p.position) {
        *out = c.raw(22, (x + POSITION_MAX) as u32)? as i32 - POSITION_MAX;
    }
    out.turn = code_rotation(c, p.turn)?;
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

/// The prior knowledge about the time of a tool's newest sample, in steps.
#[derive(Debug, Clone, Copy)]
enum TimePrior {
    /// The header contains it.
    Whole(i64),
    /// It is close to this value.
    Near(i64),
    /// The first tool of the datagram has this one.
    First(i64),
}

/// Codes the time of the newest sample.
fn code_time(
    c: &mut impl Coder,
    m: &mut Model,
    prior: TimePrior,
    baseline: Option<(i32, i64)>,
    time: i64,
) -> Result<i64, ProtocolError> {
    let narrow = |t: i64| t.clamp(-i64::from(i32::MAX), i64::from(i32::MAX)) as i32;
    match (prior, baseline) {
        (TimePrior::Whole(time), _) => Ok(time),
        (_, Some((ago, before))) => {
            let since = time.saturating_sub(before);
            let batches = (since + BATCH_UNITS / 2).div_euclid(BATCH_UNITS);
            let skipped = m.batches.code(c, ago.wrapping_sub(narrow(batches)))?;
            let start = i64::from(ago.wrapping_sub(skipped)) * BATCH_UNITS;
            let rest = m.rest.code(c, narrow(since - start))?;
            Ok(before.saturating_add(start + i64::from(rest)))
        }
        (TimePrior::Near(near), None) => {
            let low = c.raw(16, u32::from(time as u16))?;
            Ok(nearest_time(low as u16, near))
        }
        (TimePrior::First(first), None) => {
            let age = m.age.code(c, narrow(first.saturating_sub(time)))?;
            Ok(first.saturating_sub(i64::from(age)))
        }
    }
}

/// Codes the samples of one tool, oldest first. A decoder returns as many as it reads. The baseline
/// comes with its age in datagrams.
fn code_points(
    c: &mut impl Coder,
    m: &mut Model,
    prior: TimePrior,
    baseline: Option<(i32, Anchor)>,
    points: &mut [Point],
) -> Result<Anchor, ProtocolError> {
    let last = points.len() - 1;
    let narrow = |t: i64| t.clamp(-i64::from(i32::MAX), i64::from(i32::MAX)) as i32;
    let before = baseline.map(|(ago, anchor)| (ago, anchor.newest.time));
    points[last].time = code_time(c, m, prior, before, points[last].time)?;
    let baseline = baseline.map(|(_, anchor)| anchor);
    for i in (0..last).rev() {
        let step = points[i + 1].time.saturating_sub(points[i].time);
        let step = i64::from(m.step.code(c, narrow(step - PERIOD))?) + PERIOD;
        if step < 0 {
            return Err(refuse("the step between samples", format!("{step} steps")));
        }
        points[i].time = points[i + 1].time.saturating_sub(step);
    }
    points[last] = match &baseline {
        Some(anchor) => {
            let after = points[last].time.saturating_sub(anchor.newest.time);
            m.expect(after);
            code_point(c, m, 0, &anchor.extrapolated(after), points[last])?
        }
        None => code_whole(c, points[last])?,
    };
    let newest = points[last];
    if last > 0 {
        let back = points[0].time.saturating_sub(newest.time);
        let near = match &baseline {
            Some(a) if a.newest.turn.omitted == newest.turn.omitted => {
                // The newest known motion: from the baseline to here.
                let span = newest.time.saturating_sub(a.newest.time);
                if (1..FAR_UNITS).contains(&span) {
                    on_parabola(a, &newest, span + back, span)
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

/// Codes the samples between two known ones, the middle one first.
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
    points[middle].settle(&near);
    points[middle] = code_point(c, m, 2, &near, points[middle])?;
    code_between(c, m, points, from, middle)?;
    code_between(c, m, points, middle, to)
}

fn write_track(
    c: &mut impl Coder,
    m: &mut Model,
    at: Moment,
    prior: TimePrior,
    memory: &Memory,
    track: &ToolTrack,
) -> Result<Anchor, ProtocolError> {
    let count = track.samples.len();
    let Some(newest) = track.samples.last().filter(|_| count <= TRACK_MAX_SAMPLES) else {
        return Err(refuse("the number of samples", count.to_string()));
    };
    let stream = i32::from(at.stream.0);
    m.participant
        .code(c, i32::from(track.participant.0) - stream)?;
    m.samples.code(c, USUAL_SAMPLES as i32 - count as i32)?;
    code_lateness(c, &mut m.late, track.late)?;
    let time = quantise::time(newest.time);
    let known = memory.known_point(track.participant).filter(|(_, anchor)| {
        let since = time.saturating_sub(anchor.newest.time);
        (-FAR_UNITS..FAR_UNITS).contains(&since)
    });
    c.bit(&mut m.has_baseline, known.is_some())?;
    let mut baseline = None;
    if let Some((sequence, anchor)) = known {
        let ago = at.sequence.wrapping_sub(sequence) as i32;
        m.ago.code(c, ago)?;
        baseline = Some((ago, anchor));
    }
    let turn = baseline.map(|(_, anchor)| anchor.newest.turn);
    let newest = Point::of(newest, turn)?;
    let mut points = Vec::with_capacity(count);
    for sample in &track.samples {
        points.push(Point::of(sample, Some(newest.turn))?);
    }
    points[count - 1] = newest;
    code_points(c, m, prior, baseline, &mut points)
}

fn read_track(
    c: &mut impl Coder,
    m: &mut Model,
    at: Moment,
    prior: TimePrior,
    memory: &Memory,
) -> Result<(ToolTrack, Anchor), ProtocolError> {
    let participant = i32::from(at.stream.0) + m.participant.code(c, 0)?;
    let participant = u16::try_from(participant)
        .map(ParticipantId)
        .map_err(|_| refuse("a participant", participant.to_string()))?;
    let count = USUAL_SAMPLES as i32 - m.samples.code(c, 0)?;
    let count = usize::try_from(count).unwrap_or(0);
    if !(1..=TRACK_MAX_SAMPLES).contains(&count) {
        return Err(refuse("the number of samples", count.to_string()));
    }
    let late = code_lateness(c, &mut m.late, Lateness::NONE)?;
    let baseline = if c.bit(&mut m.has_baseline, false)? {
        let ago = m.ago.code(c, 0)?;
        let sequence = at.sequence.wrapping_sub(ago as u32);
        let known = memory.point_at(participant, sequence);
        let anchor = known.ok_or(ProtocolError::NoBaseline { sequence })?;
        Some((ago, anchor))
    } else {
        None
    };
    let mut points = [Point::default(); TRACK_MAX_SAMPLES];
    let points = &mut points[..count];
    let anchor = code_points(c, m, prior, baseline, points)?;
    let samples = points.iter().map(Point::sample).collect();
    let track = ToolTrack {
        participant,
        samples,
        late,
    };
    Ok((track, anchor))
}

/// The prior knowledge about the time of the next tool.
fn time_prior(at: Moment, first: Option<i64>) -> TimePrior {
    let near = quantise::time(at.generated);
    match first {
        Some(first) => TimePrior::First(first),
        None if at.is_whole => TimePrior::Whole(near),
        None => TimePrior::Near(near),
    }
}

fn refuse_count(count: i64) -> ProtocolError {
    let detail = format!("{count}, where 1 to {TRACKS_MAX} are allowed");
    refuse("the number of tools", detail)
}

/// Writes the body, and remembers its content.
pub(super) fn write(
    c: &mut impl Coder,
    at: Moment,
    memory: &mut Memory,
    tracks: &[ToolTrack],
) -> Result<(), ProtocolError> {
    if !(1..=TRACKS_MAX).contains(&tracks.len()) {
        return Err(refuse_count(tracks.len() as i64));
    }
    let mut m = Model::new();
    let mut first = None;
    m.tracks.code(c, tracks.len() as i32 - 1)?;
    for track in tracks {
        let anchor = write_track(c, &mut m, at, time_prior(at, first), memory, track)?;
        first = first.or(Some(anchor.newest.time));
        memory.remember_point(track.participant, at.sequence, anchor);
    }
    Ok(())
}

/// Reads the body, and remembers its content.
pub(super) fn read(
    c: &mut impl Coder,
    at: Moment,
    memory: &mut Memory,
) -> Result<Vec<ToolTrack>, ProtocolError> {
    let mut m = Model::new();
    let count = i64::from(m.tracks.code(c, 0)?) + 1;
    if !(1..=TRACKS_MAX as i64).contains(&count) {
        return Err(refuse_count(count));
    }
    let mut tracks = Vec::new();
    let mut first = None;
    for _ in 0..count {
        let (track, anchor) = read_track(c, &mut m, at, time_prior(at, first), memory)?;
        first = first.or(Some(anchor.newest.time));
        memory.remember_point(track.participant, at.sequence, anchor);
        tracks.push(track);
    }
    Ok(tracks)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn predictions_are_in_range_for_any_steps_on_the_wire(
            ends in [-POSITION_MAX..=POSITION_MAX, -POSITION_MAX..=POSITION_MAX, -POSITION_MAX..=POSITION_MAX],
            before in 1_i64..=VELOCITY_UNITS,
            span in 1_i64..FAR_UNITS,
            at in -8 * FAR_UNITS..8 * FAR_UNITS,
        ) {
            let point = |x, time| Point { time, position: [x; 3], ..Point::default() };
            let base = Anchor { oldest: point(ends[0], -before), newest: point(ends[1], 0) };
            let found = on_parabola(&base, &point(ends[2], span), at, span);
            prop_assert!(found.position.iter().all(|x| x.abs() <= POSITION_MAX));
        }
    }
}
