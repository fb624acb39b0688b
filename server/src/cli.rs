//! The command line of `palpate-server`.

use std::ffi::OsString;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::cut::{self, CutOptions};
use crate::export::Exports;
use crate::host::{self, HostOptions};
use crate::inspect::Picture;
use crate::output::print_result;
use crate::{ServerError, build, inspect, sample};

/// The end of `build --help`.
const SCENE: &str = "\
A scene names closed surfaces, or the labels of a segmentation. Surfaces are looked for beside it:
  format = \"palpate-scene/1\"
  spacing_mm = 4.0                    # or \"auto\": as fine as the thinnest layers
  pinned = [\"femur\"]                  # regions that do not move
  fuse = [[\"femur\", \"tibia\"]]         # optional: join these where less than a cell is between them
  gravity_m_s2 = [0.0, 0.0, -9.81]    # optional: the surfaces are the shape without it
  labels = \"segmentation.nii.gz\"      # for regions with a label

  [[region]]                          # a later region overrides earlier ones where they overlap
  name = \"fat\"
  surface = \"skin.stl\"                # millimetres unless unit = \"m\"; or label = 2, or label = [2, 5]
  material = \"fat\"

  [report]                            # optional: deviations that are warned of; the defaults are
  dice = 0.9                          # least Dice coefficient of a region with its input
  volume_percent = 1.0                # error of its volume
  distance_mm = 8.0                   # between its surfaces; two spacings unless given
  contact_mm2 = 10.0                  # contact of two regions that was created or removed
  component_mm3 = 1.0                 # components that were lost or joined, from this volume on
  self_intersections = 0              # pairs of triangles of surfaces that pass through each other

  [material.fat]                      # optional: changes a built-in material or adds one
  young_kpa = 10.0
  poisson = 0.45                      # 0.25 (springs alone) to 0.49; soft tissue has 0.45
  stiffening = 0.0                    # b of F = k l0 (exp(b e) - 1)/b over the strain e; 0: linear
  fibre_ratio = 1.0                   # stiffness along the fibres over that across
  fibres = \"long\"                     # along the region's long axis, or [x, y, z]
  compress_limit = 0.3                # shares of the rest length at which a spring hardens
  stretch_limit = 3.0
  bottoms_out = true                  # hardens when pressed flat; false: a fifth faster under a hand
  density_kg_m3 = 950.0
  friction_static = 0.4
  friction_dynamic = 0.3
  toughness_j_m2 = 200.0              # against a sharp blade: a cut 10 mm deep takes 2 N

A [[region]] takes the keys of a material too, for itself alone.";

/// The end of `cut --help`.
const CUT: &str = "\
The strokes file lists the strokes in order. Lengths are in mm:
  [[stroke]]
  points_mm = [[-30.0, 65.5, 100.0], [0.0, 73.2, 100.0], [30.0, 66.0, 100.0]]
  depth_mm = 25.0                     # below the points; or a list with one depth per point
  width_mm = 0.3                      # of the wound at its top, at most 0.1 spacings; default 0
  direction = [0.0, -1.0, 0.0]        # of the depth; default: the inward normal at each point

A stroke has 2 to 4096 points on the surface; give a direction if its path leaves the model. A
point is the place where the blade enters; its tip is one depth further along the direction. An
impossible stroke is refused with its reason and changes nothing; the command then succeeds. The
report counts strokes and points from 0. Its times are per stroke.

The output is a model in which the cuts can not be taken back. Strokes on it continue the cuts. The
mass of a cell in it follows its volume after the cuts.

Examples:
  palpate-server cut thigh --strokes strokes.toml -o cut.palp --png wound.png
  palpate-server cut cut.palp --strokes more.toml -o cut-again.palp --json
  palpate-server host cut.palp";

/// The end of `host --help`.
const HOST: &str = "\
Roles, each with a join link of its own:
  instructor, trainee   hold a tool, feel and cut
  spectator             watches without a tool
  recorder              a program that records the session: a spectator with `--record FILE`

The certificate, its key and the secrets in the links are kept in one file that only its owner may read. So links stay
valid when the host is restarted. A restarted host begins with uncut tissue, unless it has a session file: that keeps
every cut, with undo and redo, within some milliseconds. Clients of a host that crashed join the restarted one by
themselves; Ctrl-C ends the session for all.

Examples:
  palpate-server host thigh                          on port 4433 of all addresses
  palpate-server host thigh.palp --listen 5000       on another port
  palpate-server host thigh --public host.example.org
  palpate-server host thigh --session monday.cuts    keep the cuts, and continue with them after a restart
  palpate-server host thigh --new-links              earlier links become invalid
  palpate-server host thigh --identity new           a temporary identity";

/// Hosts shared haptic sessions: build a model, host it, send the join links.
#[derive(Debug, Parser)]
#[command(
    name = "palpate-server",
    version,
    after_help = "Examples:\n  \
        palpate-server host thigh                      serve a built-in model on port 4433\n  \
        palpate-server sample thigh -o thigh           write its surfaces and scene, to change them\n  \
        palpate-server build thigh/thigh.toml -o thigh.palp\n  \
        palpate-server inspect thigh.palp --png thigh.png --slice z=100\n  \
        palpate-server inspect segmentation.nii.gz     its labels, to write a scene for it\n  \
        palpate-server cut thigh.palp --strokes strokes.toml -o cut.palp\n  \
        palpate-server host thigh.palp --listen 0.0.0.0:4433 --public operating.example.org\n\n\
        A trainee joins with `palpate-client join LINK`, where LINK is what `host` prints.\n\n\
        PALPATE_LOG=debug (or RUST_LOG) logs more to standard error; the levels are error, warn, info, debug and trace."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Write a built-in sample as closed surfaces (STL, mm) with a scene file
    Sample {
        /// thigh, abdominal-wall, leg or handle
        name: String,
        /// Folder to write into; created if missing
        #[arg(short, long, value_name = "DIR")]
        output: PathBuf,
        /// Overwrite existing files
        #[arg(long)]
        force: bool,
    },
    /// Build a model file from a scene
    #[command(after_help = SCENE)]
    Build {
        /// The scene (palpate-scene/1, TOML): regions from surfaces (STL, OBJ, PLY) or from the
        /// labels of a segmentation (NIfTI, NRRD, DICOM)
        scene: PathBuf,
        /// Model file to write
        #[arg(short, long, value_name = "FILE.palp")]
        output: PathBuf,
        #[command(flatten)]
        exports: Exports,
        /// Print the report as one JSON object
        #[arg(long)]
        json: bool,
        /// Fail (exit code 1) and write no file where the model deviates from its input beyond the
        /// thresholds of the scene's [report], or an input surface is faulty
        #[arg(long)]
        strict: bool,
    },
    /// Cut a model along strokes, without a session
    #[command(after_help = CUT)]
    Cut(CutOptions),
    /// Show the contents of a model file or a label volume
    Inspect {
        /// The model file (.palp), or a label volume: .nii, .nii.gz, .nrrd, .nhdr, a DICOM folder
        file: PathBuf,
        #[command(flatten)]
        exports: Exports,
        #[command(flatten)]
        picture: Picture,
        /// Print it as one JSON object
        #[arg(long)]
        json: bool,
    },
    /// Serve a session and print a join link per role
    #[command(after_help = HOST)]
    Host(HostOptions),
}

/// Runs the command line `args`, whose first element is the program name.
pub fn run(args: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(error) => {
            // clap prints help to standard output (code 0) and errors to standard error (code 2).
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    palpate_transport::start_log(palpate_transport::LevelFilter::WARN);
    match execute(cli.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // A closed standard error is ignored.
            let _ = writeln!(std::io::stderr(), "palpate-server: {error}");
            match error {
                ServerError::CommandLine(_) => ExitCode::from(2),
                _ => ExitCode::FAILURE,
            }
        }
    }
}

fn execute(command: Command) -> Result<(), ServerError> {
    match command {
        Command::Sample {
            name,
            output,
            force,
        } => {
            let scene = sample::write(&name, &output, force)?;
            print_result(&scene.display().to_string())?;
        }
        Command::Build {
            scene,
            output,
            exports,
            json,
            strict,
        } => {
            let summary = build::build_file(&scene, &output, &exports, strict)?;
            let deviations = if strict { summary.report.deviations } else { 0 };
            if json {
                print_result(&serde_json::json!(summary).to_string())?;
            } else if deviations > 0 {
                print_result(&build::describe(&summary))?;
            } else {
                let text = build::describe(&summary);
                print_result(&format!("{text}\nwritten to {}", output.display()))?;
            }
            if deviations > 0 {
                return Err(ServerError::Deviations(deviations));
            }
        }
        Command::Cut(options) => {
            let summary = options.run()?;
            print_result(&if options.json {
                serde_json::json!(summary).to_string()
            } else {
                cut::describe(&summary)
            })?;
        }
        Command::Inspect {
            file,
            exports,
            picture,
            json,
        } => {
            let (value, text) = inspect::inspect(&file, &exports, &picture)?;
            print_result(&if json { value.to_string() } else { text })?;
        }
        Command::Host(options) => host::host(&options)?,
    }
    Ok(())
}
