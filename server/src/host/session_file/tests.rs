//! The session file over restarts, crashes, damage and wrong models.

use palpate_protocol::operation::{BladePoint, OperationKind};
use palpate_protocol::{OperationId, ServerTime, Span};
use palpate_site::tissue_stroke;
use palpate_tissue::{Material, block};

use super::*;

fn model() -> Arc<Model> {
    Arc::new(block([6, 8, 4], 4e-3, &Material::default(), 1))
}

/// A tissue and the operations that changed it.
struct Session {
    topology: Arc<Topology>,
    history: CutHistory,
    log: Vec<Arc<Operation>>,
}

impl Session {
    fn new(model: &Arc<Model>) -> Self {
        let topology = Arc::new(Topology::new(Arc::clone(model)));
        let history = CutHistory::new(Arc::clone(&topology));
        Self {
            topology,
            history,
            log: Vec::new(),
        }
    }

    /// Changes the tissue. The `n`-th stroke is at a place of its own, by a participant of its own.
    fn change(&mut self, kind: Option<OperationKind>) {
        let n = self.log.len() as u16;
        let author = ParticipantId(n + 1);
        let before = self.topology.version();
        let kind = kind.unwrap_or_else(|| OperationKind::Cut(stroke(n)));
        match &kind {
            OperationKind::Cut(part) => {
                let part = tissue_stroke(author, part);
                self.history.cut(&mut self.topology, part).unwrap();
            }
            OperationKind::Undone => drop(self.history.undo(&mut self.topology).unwrap()),
            other => panic!("{other:?}"),
        }
        self.log.push(Arc::new(Operation {
            id: OperationId(n.into()),
            at: ServerTime::ZERO,
            author,
            topology_version_before: before,
            topology_version_after: self.topology.version(),
            hash_after: TopologyHash(self.topology.hash().0),
            kind,
        }));
    }

    fn hash(&self) -> TopologyHash {
        TopologyHash(self.topology.hash().0)
    }
}

fn stroke(n: u16) -> CutStroke {
    let y = 3e-3 + 4e-3 * f64::from(n % 7);
    let point = |x: f64| {
        let point = BladePoint {
            tip_m: [x, y, 8e-3],
            axis: [0.0, 0.0, 1.0],
            depth_m: 8e-3,
        };
        point.rounded()
    };
    CutStroke {
        began: ServerTime::ZERO + Span::from_millis(i64::from(n)),
        joins: false,
        points: vec![point(2e-3), point(20e-3)],
        width_m: 0.0,
    }
}

fn opened(path: &Path, model: &Arc<Model>) -> (SessionFile, Option<Continued>) {
    SessionFile::open(path, model).unwrap()
}

fn refusal(path: &Path, model: &Arc<Model>) -> String {
    let error = SessionFile::open(path, model).err().unwrap();
    error.to_string()
}

#[test]
fn restarted_session_has_every_cut_with_undo_and_redo() {
    let (dir, model) = (tempfile::tempdir().unwrap(), model());
    let path = dir.path().join("a.cuts");
    let mut session = Session::new(&model);
    let (file, before) = opened(&path, &model);
    assert!(before.is_none());
    assert!(file.finish());
    let (file, before) = opened(&path, &model);
    assert!(before.is_none(), "no cut yet");
    for _ in 0..3 {
        session.change(None);
    }
    session.change(Some(OperationKind::Undone));
    file.note(&session.log);
    assert!(file.finish());
    // With a snapshot and without.
    for _ in 0..2 {
        let (file, before) = opened(&path, &model);
        let before = before.unwrap();
        assert_eq!(before.state, (4, session.hash()));
        assert_eq!(before.newest, ParticipantId(3));
        let strokes = session.history.stroke_numbers();
        assert_eq!([before.strokes[0].len(), before.strokes[1].len()], [2, 1]);
        assert_eq!(before.strokes, strokes);
        assert_eq!(before.tissue.history().stroke_numbers(), strokes);
        assert!(file.finish());
    }
    let (file, _) = opened(&path, &model);
    session.change(None);
    let bytes = snapshot(&session.topology, &session.history);
    session.change(None);
    file.note(&session.log[4..]);
    file.cover(5, &bytes);
    assert!(file.finish());
    let (_, before) = opened(&path, &model);
    assert_eq!(before.unwrap().state, (6, session.hash()));
}

#[test]
fn unfinished_record_is_dropped_and_the_whole_file_kept_beside() {
    let (dir, model) = (tempfile::tempdir().unwrap(), model());
    let path = dir.path().join("a.cuts");
    let mut session = Session::new(&model);
    let mut hashes = vec![(0, session.hash())];
    let mut sizes = vec![HEADER_BYTES];
    let (file, _) = opened(&path, &model);
    for n in 0..3 {
        session.change(None);
        file.note(&session.log[n..]);
        hashes.push((n as u32 + 1, session.hash()));
    }
    assert!(file.finish());
    let whole = std::fs::read(&path).unwrap();
    while let Some((.., after)) = next_record(&whole[sizes[sizes.len() - 1]..]) {
        sizes.push(whole.len() - after.len());
    }
    assert_eq!(sizes.len(), 4);
    for length in HEADER_BYTES..=whole.len() {
        std::fs::write(&path, &whole[..length]).unwrap();
        let beside = dir.path().join("a.cuts.damaged-1");
        let _ = std::fs::remove_file(&beside);
        let kept = sizes.iter().filter(|s| **s <= length).count() - 1;
        let (file, before) = opened(&path, &model);
        let state = before.map_or(hashes[0], |b| b.state);
        assert_eq!(state, hashes[kept], "{length} bytes");
        assert_eq!(beside.exists(), !sizes.contains(&length), "{length} bytes");
        assert!(file.finish());
    }
}

#[test]
fn damaged_and_unfit_files_are_refused_and_stay_unchanged() {
    let (dir, model) = (tempfile::tempdir().unwrap(), model());
    let path = dir.path().join("a.cuts");
    let mut session = Session::new(&model);
    let (file, _) = opened(&path, &model);
    session.change(None);
    file.note(&session.log);
    let other = Arc::new(block([5, 6, 4], 4e-3, &Material::default(), 1));
    assert!(refusal(&path, &model).contains("in use by another host"));
    assert!(file.finish());
    let bytes = std::fs::read(&path).unwrap();
    assert!(refusal(&path, &other).contains("belongs to another model"));
    assert_eq!(std::fs::read(&path).unwrap(), bytes);
    let mut newer = bytes.clone();
    newer[8] += 1;
    std::fs::write(&path, &newer).unwrap();
    assert!(refusal(&path, &model).contains("protocol version"));
    session.change(None);
    session.change(None);
    std::fs::write(&path, &bytes).unwrap();
    let (file, _) = opened(&path, &model);
    file.note(&session.log[1..]);
    assert!(file.finish());
    let whole = std::fs::read(&path).unwrap();
    // The snapshot, and a change.
    for at in [HEADER_BYTES + 30, whole.len() * 3 / 4] {
        let mut damaged = whole.clone();
        damaged[at] ^= 1;
        std::fs::write(&path, &damaged).unwrap();
        let said = refusal(&path, &model);
        assert!(said.contains("is damaged at byte"), "{at}: {said}");
        assert_eq!(std::fs::read(&path).unwrap(), damaged);
    }
    assert!(refusal(dir.path(), &model).contains("no regular file"));
    let text = dir.path().join("notes.txt");
    std::fs::write(&text, "a shopping list of the instructor").unwrap();
    assert!(refusal(&text, &model).contains("is no session file"));
    let absent = dir.path().join("absent/a.cuts");
    assert!(refusal(&absent, &model).contains("cannot write"));
}

#[test]
fn cuts_are_written_once_an_error_is_over() {
    let (dir, model) = (tempfile::tempdir().unwrap(), model());
    let folder = dir.path().join("disk");
    std::fs::create_dir(&folder).unwrap();
    let path = folder.join("a.cuts");
    let mut session = Session::new(&model);
    let (file, _) = opened(&path, &model);
    session.change(None);
    file.note(&session.log);
    // A snapshot replaces the file, which is not possible now.
    std::fs::remove_dir_all(&folder).unwrap();
    file.cover(1, &snapshot(&session.topology, &session.history));
    session.change(None);
    file.note(&session.log[1..]);
    std::thread::sleep(RETRY / 4);
    std::fs::create_dir(&folder).unwrap();
    let began = std::time::Instant::now();
    while !path.exists() {
        assert!(began.elapsed() < 20 * RETRY, "nothing is written again");
        std::thread::sleep(RETRY / 10);
    }
    assert!(file.finish());
    let (_, before) = opened(&path, &model);
    assert_eq!(before.unwrap().state, (2, session.hash()));
}
