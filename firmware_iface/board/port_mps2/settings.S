/* The record of settings, as a flash page of its own would hold it. */
.section .settings, "a"
.global stored_settings
.global stored_settings_end
stored_settings:
.incbin SETTINGS
stored_settings_end:
