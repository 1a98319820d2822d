//! Validation of files against the rules of their format: reports all faults, not only the first.
//!
//! Readers stop at the first unusable value; validation examines everything and reports place, expectation and finding.
//! For glTF, PLY and SPZ it shares no code with the readers except the containers, the properties of a PLY and the
//! digest of bindings; other formats are checked by their readers.

mod gltf;
mod ply;
mod spz;
mod usd;

use std::fmt;
use std::path::Path;

use serde::Serialize;

use super::error::{Fault, FormatError, Location, one_line, read_file};
use super::{Format, detect, read_scene};

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Allowed, but probably unintended, or not understood by Centaur.
    Warning,
    /// Forbidden by the format.
    Error,
}

/// Fault of a file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Severity of the fault.
    pub severity: Severity,
    /// Code of the broken rule, for scripts: `ACCESSOR_RANGE`.
    pub code: &'static str,
    /// Place of the fault: a JSON pointer into the glTF document, or an offset in bytes.
    pub location: Location,
    /// Value required by the rule.
    pub expected: String,
    /// Value found.
    pub found: String,
}

/// All findings of a file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Validation {
    /// Path as given.
    pub file: String,
    /// `glTF`, `PLY`, `SOG`, `SPZ`, `splat`, `ksplat` or `USD`.
    pub format: &'static str,
    /// Number of findings that are errors.
    pub errors: usize,
    /// Number of findings that are warnings.
    pub warnings: usize,
    /// Findings: container first, then structure, then values.
    pub findings: Vec<Finding>,
}

/// Checks a file against the rules of its format.
///
/// * `.glb`, `.gltf`: container, schema, references, ranges of accessors and their values, declared extensions, the
///   rules of `KHR_gaussian_splatting` and of `EXT_gaussian_splatting_hybrid`.
/// * `.ply` of splats: header, rows against the length of the file, values.
/// * `.spz`: container, streams against the number of splats, values at the ends of their ranges.
/// * `.usda`, `.usdc`, `.usdz`: what the reader refuses, lengths of arrays against their interpolation, extents,
///   maps of ours that cannot be read.
/// * other files of splats: what the reader refuses.
///
/// # Errors
/// If the file cannot be read or is of none of these formats. Faults *in* the file are findings, not errors.
pub fn validate(path: &Path) -> Result<Validation, FormatError> {
    let (format, folder) = (detect(path)?, path.parent().unwrap_or(Path::new("")));
    let mut findings = Findings::default();
    match format {
        Format::Glb | Format::Gltf => gltf::check(&read_file(path)?, folder, &mut findings),
        Format::Ply | Format::CompressedPly => ply::check(&read_file(path)?, &mut findings),
        Format::Spz => spz::check(&read_file(path)?, &mut findings),
        Format::Usda | Format::Usdc | Format::Usdz => {
            let found = findings.content(usd::check(path))?;
            findings.0.extend(found.into_iter().flatten());
        }
        _ => drop(findings.content(read_scene(path))?),
    }
    let Findings(findings) = findings;
    let errors = findings.iter().filter(|f| f.severity == Severity::Error).count();
    let warnings = findings.len() - errors;
    Ok(Validation { file: path.display().to_string(), format: format.name(), errors, warnings, findings })
}

/// Warnings, as in a [`Validation`], about mistyped properties of the hybrid extension in the JSON of a glTF, one
/// sentence each.
pub(super) fn unknown_properties(root: &serde_json::Value) -> Vec<String> {
    gltf::unknown_properties(root)
}

/// Collector of findings.
#[derive(Default)]
struct Findings(Vec<Finding>);

impl Findings {
    #[expect(clippy::needless_pass_by_value, reason = "numbers and strings, without & at every call")]
    fn error(
        &mut self,
        code: &'static str,
        at: impl Into<Location>,
        expected: impl Into<String>,
        found: impl ToString,
    ) {
        self.add(Severity::Error, code, at.into(), expected.into(), found.to_string());
    }

    #[expect(clippy::needless_pass_by_value, reason = "numbers and strings, without & at every call")]
    fn warning(
        &mut self,
        code: &'static str,
        at: impl Into<Location>,
        expected: impl Into<String>,
        found: impl ToString,
    ) {
        self.add(Severity::Warning, code, at.into(), expected.into(), found.to_string());
    }

    /// Adds a reader's fault as an error.
    fn fault(&mut self, code: &'static str, fault: Fault) {
        let Fault { location, expected, found } = fault;
        self.add(Severity::Error, code, location, expected, found);
    }

    /// Turns a reader's content error into a finding.
    fn content<T>(&mut self, read: Result<T, FormatError>) -> Result<Option<T>, FormatError> {
        match read {
            Err(FormatError::Content { fault, .. }) => {
                self.fault("CONTENT", fault);
                Ok(None)
            }
            other => other.map(Some),
        }
    }

    fn has_errors(&self) -> bool {
        self.0.iter().any(|f| f.severity == Severity::Error)
    }

    fn add(&mut self, severity: Severity, code: &'static str, location: Location, expected: String, found: String) {
        self.0.push(Finding { severity, code, location, expected, found });
    }
}

/// Converts from a JSON pointer.
impl From<String> for Location {
    fn from(pointer: String) -> Self {
        Self::Pointer(pointer)
    }
}

impl From<&str> for Location {
    fn from(pointer: &str) -> Self {
        Self::Pointer(pointer.to_owned())
    }
}

impl From<&String> for Location {
    fn from(pointer: &String) -> Self {
        Self::Pointer(pointer.clone())
    }
}

/// Number of values that break a rule, and the first of them.
#[derive(Default)]
struct Offenders {
    count: usize,
    first: Option<String>,
}

impl Offenders {
    fn note(&mut self, describe: impl FnOnce() -> String) {
        self.count += 1;
        if self.first.is_none() {
            self.first = Some(describe());
        }
    }

    /// Formats `7 of 100, the first: …`; `None` if no value breaks the rule.
    fn summary(self, of: usize) -> Option<String> {
        let first = self.first?;
        Some(format!("{} of {of}, the first: {first}", self.count))
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let severity = match self.severity {
            Severity::Error => "error",
            Severity::Warning => "warning",
        };
        let Self { code, location, .. } = self;
        let [expected, found] = [&self.expected, &self.found].map(|text| one_line(text));
        write!(f, "{severity} {code}: {location}expected {expected}, found {found}")
    }
}

impl fmt::Display for Validation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.findings.iter().try_for_each(|finding| writeln!(f, "{finding}"))?;
        write!(f, "{}: {}, {} error(s), {} warning(s)", one_line(&self.file), self.format, self.errors, self.warnings)?;
        if [Format::Ksplat, Format::Sog, Format::Splat].iter().any(|format| format.name() == self.format) {
            write!(f, "; all that is checked of this format is that it can be read")?;
        }
        Ok(())
    }
}
