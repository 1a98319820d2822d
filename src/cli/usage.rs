//! Wrong usage that clap does not detect: incompatible arguments, and flags within flags. Reported on one line like any
//! failure, but with the exit code of wrong usage, so that scripts can tell a mistake in a command from one in a file.

use anyhow::Result;

/// Description of what is wrong about a command.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct WrongUsage(String);

/// Creates an error of wrong usage.
pub(super) fn wrong(message: impl Into<String>) -> anyhow::Error {
    WrongUsage(message.into()).into()
}

/// Returns an error of wrong usage unless `holds`.
pub(super) fn demand(holds: bool, message: impl Into<String>) -> Result<()> {
    if holds { Ok(()) } else { Err(wrong(message)) }
}

/// Whether an error is one of wrong usage, regardless of added context.
pub(super) fn is_wrong(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.downcast_ref::<WrongUsage>().is_some())
}

#[cfg(test)]
mod tests {
    use anyhow::{Context as _, anyhow};

    use super::*;

    #[test]
    fn wrong_usage_is_told_from_failures_under_any_context() {
        let error = demand(false, "a and b").context("flags of x").unwrap_err();
        assert!(is_wrong(&error) && format!("{error:#}") == "flags of x: a and b", "{error:#}");
        assert!(!is_wrong(&anyhow!("a and b")) && demand(true, "a").is_ok());
    }
}
