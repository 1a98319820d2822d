#!/usr/bin/env bash
# Succeeds if a Vulkan adapter can be expected: the loader exists, and a driver that is either software (lavapipe,
# SwiftShader) or has a device. Driver manifests alone are not enough: Mesa installs those of all vendors.
set -euo pipefail
# No `grep -q` here: it closes the pipe at the first match, which sometimes makes the writing command fail.

loader() {
    PATH=$PATH:/sbin:/usr/sbin ldconfig -p 2>/dev/null | grep 'libvulkan\.so\.1' >/dev/null
}

drivers() {
    if [ -n "${VK_DRIVER_FILES:-${VK_ICD_FILENAMES:-}}" ]; then
        tr ':' '\n' <<<"${VK_DRIVER_FILES:-$VK_ICD_FILENAMES}"
    else
        find /usr/share/vulkan/icd.d /usr/local/share/vulkan/icd.d /etc/vulkan/icd.d \
            "${XDG_DATA_HOME:-${HOME:-}/.local/share}/vulkan/icd.d" -name '*.json' 2>/dev/null || true
    fi
}

device() {
    compgen -G '/dev/dri/renderD*' >/dev/null || [ -e /dev/nvidia0 ] || [ -e /dev/dxg ]
}

loader && [ -n "$(drivers)" ] && { drivers | grep -Ei 'lvp_icd|lavapipe|swiftshader' >/dev/null || device; }
