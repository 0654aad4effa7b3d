//! `reviv view` opens a page where pages can be opened, with an opener of this test's own on the path.

use assert_cmd::Command;
use std::path::Path;

const WRITES_DOWN: &str = "printf %s \"$1\" > \"$REVIV_OPENED\"";

/// `reviv view` with `arguments`, in `place`, where `opener` is what opens pages (none without); stdout and stderr.
fn viewed(
    place: &Path,
    arguments: &[&str],
    display: Option<&str>,
    opener: Option<&str>,
) -> (String, String) {
    use std::os::unix::fs::PermissionsExt as _;
    let bin = place.join("bin");
    std::fs::create_dir_all(&bin).unwrap();
    if let Some(opener) = opener {
        let script = bin.join("xdg-open");
        std::fs::write(&script, format!("#!/bin/sh\n{opener}\n")).unwrap();
        std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o755)).unwrap();
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_reviv"));
    command
        .current_dir(place)
        .env("PATH", &bin)
        .env("REVIV_OPENED", place.join("opened"))
        .env_remove("DISPLAY")
        .env_remove("WAYLAND_DISPLAY")
        .env_remove("WSL_DISTRO_NAME")
        .args(["view"])
        .args(arguments);
    if let Some(display) = display {
        command.env("DISPLAY", display);
    }
    let done = command.assert().success();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        text(&done.get_output().stdout),
        text(&done.get_output().stderr),
    )
}

#[test]
fn a_page_is_opened_by_what_opens_pages_and_only_printed_without() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let made = place.join("out");
    std::fs::create_dir(&made).unwrap();
    std::fs::write(made.join("view.html"), "<html>").unwrap();
    let opened = || std::fs::read_to_string(place.join("opened")).ok();

    // Nothing opens pages, or there is no screen: the path is there all the same.
    for opener in [None, Some("exit 3")] {
        let (path, said) = viewed(place, &["out"], Some(":0"), opener);
        assert_eq!(path, "out/view.html\n");
        assert!(said.starts_with("nothing here opens a page: "), "{said}");
    }
    let writes = Some(WRITES_DOWN);
    let (path, said) = viewed(place, &["out"], None, writes);
    assert_eq!(path, "out/view.html\n");
    assert!(said.starts_with("no screen here"), "{said}");
    let (path, said) = viewed(place, &["--print", "out"], Some(":0"), writes);
    assert_eq!((path.as_str(), said.as_str()), ("out/view.html\n", ""));
    let (path, _) = viewed(place, &["out", "-o", "copy.html"], Some(":0"), writes);
    assert_eq!(path, "copy.html\n");
    assert_eq!(opened(), None);

    for asked in ["out", "out/view.html"] {
        let (path, said) = viewed(place, &[asked], Some(":0"), writes);
        assert_eq!((path.as_str(), said.as_str()), ("out/view.html\n", ""));
        // The opener outlives the command.
        let mut waited = 0;
        while opened().is_none_or(|path| path.is_empty()) && waited < 500 {
            std::thread::sleep(std::time::Duration::from_millis(10));
            waited += 1;
        }
        let whole = std::path::absolute(made.join("view.html")).unwrap();
        assert_eq!(opened().as_deref(), whole.to_str());
        std::fs::remove_file(place.join("opened")).unwrap();
    }
}
