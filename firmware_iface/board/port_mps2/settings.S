/* The record of settings, as a flash page of its own would hold it. */
.section .settings, "a"
.global stored_settings
.global stored_settings_length
stored_settings:
.incbin SETTINGS
.balign 4
stored_settings_length:
.word stored_settings_length - stored_settings
